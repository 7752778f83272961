"""A T-shaped body that tumbles about its middle axis: the Dzhanibekov effect."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from pbfd_torch.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.models.setup import Metric, Setup, repeated
from pbfd_torch.rollout import Rollout
from pbfd_torch.simulator import Scene
from pbfd_torch.terms.inertia import Inertia


def _bar(mass: float, half: tuple[float, float, float], at: tuple[float, float, float]) -> torch.Tensor:
    """Inertia about the origin of a box of uniform density centred at `at`."""
    h, c = torch.tensor(half, dtype=torch.float64), torch.tensor(at, dtype=torch.float64)
    second = mass * (torch.diag(h * h) / 3 + torch.outer(c, c))
    return torch.trace(second) * torch.eye(3, dtype=torch.float64) - second


def dzhanibekov(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Two bars in the shape of a T, 20 rad/s about the middle axis with a small disturbance, no gravity."""
    mass = 0.5
    bars = [((0.05, 0.3, 0.05), (0.0, 0.0, 0.0)), ((0.15, 0.05, 0.05), (0.2, 0.0, 0.0))]
    com = tuple(sum(at[i] for _, at in bars) / 2 for i in range(3))
    inertia = sum(
        (_bar(mass, half, tuple(x - c for x, c in zip(at, com, strict=True))) for half, at in bars), torch.zeros(3, 3).double()
    )
    principal = torch.linalg.eigh(inertia)
    # the body's axes are its principal axes, so that y can be the middle one
    order = [0, 1, 2]
    rows = tuple(tuple(float(principal.eigenvalues[order[i]]) if i == j else 0.0 for j in range(3)) for i in range(3))
    link = Link("body", joints=(Joint("free", JointKind.FREE),), mass=2 * mass, inertia=rows)
    articulation = Articulation.from_links([link], dtype, device)
    scene = Scene(articulation, (Inertia(),), torch.zeros(3, dtype=dtype, device=device), name="dzhanibekov")
    q = repeated(articulation.rest, worlds)
    v = q.new_zeros(worlds, 6)
    v[:, 3], v[:, 4] = 0.01, 20.0

    def metrics(rollout: Rollout) -> Mapping[str, Metric]:
        spin = (
            rollout.link_poses[:, 0, 0, :, 1]
            @ rollout.angular_momentum[0, 0]
            / torch.linalg.vector_norm(rollout.angular_momentum[0, 0])
        )
        linear, angular = rollout.linear_momentum, rollout.angular_momentum
        flips = int(((spin[1:] > 0) != (spin[:-1] > 0)).sum())
        return {
            "flips": float(flips),
            "angular_momentum_drift": float((angular - angular[:1]).abs().max() / angular[0].abs().max()),
            "linear_momentum_drift_kg_m_s": float((linear - linear[:1]).abs().max()),
            "energy_drift": float(rollout.kinetic_energy[-1, 0] / rollout.kinetic_energy[0, 0] - 1),
        }

    return Setup(scene, q, v, 10.0, 1 / 240, metrics)
