"""How far and how fast bodies may be for the numbers of a step to mean anything: far beyond what any robot does, and far below what
overflows."""

from __future__ import annotations

from torch import Tensor

FARTHEST = 1e9  # [m] or [rad] of a coordinate: positions in float64 are rounded to 0.1 µm there
FASTEST = 1e6  # [m/s] or [rad/s] of a velocity
FULLEST_TURN = 100.0  # [rad] of a joint in one step: eight shorter ones cannot follow it by far
LIGHTEST, HEAVIEST = 1e-12, 1e12  # [kg] of a link that has mass
MASSES = f"from {LIGHTEST:g} to {HEAVIEST:g} kg: rounding would hide others"
SHORTEST_QUATERNION = 1e-6  # shorter ones have no direction that is worth anything


def near(q: Tensor) -> Tensor:
    """Which worlds of configurations q `[*batch, nq]` are finite and no farther than `FARTHEST`, `[*batch]` bool."""
    return (q.abs() <= FARTHEST).all(-1)


def slow(v: Tensor, turns: Tensor, dt: Tensor) -> Tensor:
    """Which worlds with velocities v `[*batch, nv]` are finite, no faster than `FASTEST`, and turn by no more than `FULLEST_TURN`
    in a step dt [s] `[*batch]`; `turns` `[nv]` bool: which of the velocities turn. `[*batch]` bool."""
    speed = v.abs()
    turned = (speed * turns.to(v.dtype)).amax(-1) * dt
    return (speed <= FASTEST).all(-1) & (turned <= FULLEST_TURN)
