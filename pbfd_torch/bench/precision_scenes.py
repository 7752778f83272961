"""What `pbfd bench precision` compares: scene by scene, what is observed of a motion and what it should be."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.bench.precision_reference import chain_tips, middle_axes
from pbfd_torch.bench.precision_tracks import Track, rms
from pbfd_torch.models import SCENES, Setup, boxes, chains

FRAME = 0.1  # [s] for which a control is held where a scene says nothing else; the longest step of the adaptive runs


@dataclass(frozen=True)
class Case:
    """One scene and its error: the root mean square, over all that is observed, of the distance from what it should be.

    Attributes:
        scene: its name among `SCENES`.
        title: its letter in the list of scenes, and what the error is of.
        unit: of the error.
        duration: [s] simulated.
        levels: errors to be reached, falling.
        observe: (track) → `[..., n]`.
        exact: what that should be; None: each simulator is measured against itself at a fine step.
        reference: what `exact` is, in words.
        smallest_step: [s] of ours that is run; smaller ones would take too long.
        observed_s: until when there is something to observe [s], where that is less than the duration.
        control: (time `[*]`) → `[*, nu]`, or None for zero.
        numbers: which of the track's numbers tell something here.
        frame: [s] for which a control is held.
    """

    scene: str
    title: str
    unit: str
    duration: float
    levels: tuple[float, ...]
    observe: Callable[[Track], Tensor]
    exact: Callable[[], Tensor] | None
    reference: str
    smallest_step: float = 0.001
    observed_s: float = math.inf
    control: Callable[[Tensor], Tensor] | None = None
    numbers: tuple[str, ...] = ("energy_gain_J", "energy_gain")
    frame: float = FRAME

    @property
    def tracked_worlds(self) -> int:
        """Worlds that the error is taken over: the box slides under every μ."""
        return len(boxes.SLIDING_FRICTION) if self.scene == "box-slide" else 1

    def setup(self, worlds: int) -> Setup:
        """The scene, world k like world k modulo `tracked_worlds`."""
        return SCENES[self.scene](worlds=worlds)

    def controls(self, dt: float, start: Tensor) -> Tensor | None:
        """`[*, nu]` of the steps of length dt ≤ `frame` that begin at the times `[*]`. It is held for a frame, as it is in the
        middle of that, so that steps of all lengths see the same control."""
        if self.control is None:
            return None
        return self.control(self.frame * (torch.floor((start + 0.5 * dt) / self.frame) + 0.5))

    def error(self, track: Track, reference: Tensor) -> float:
        """In `unit`; NaN where the motion is not finite."""
        return rms(self.observe(track) - reference)


def tenths(last: float, first: float = 0.1) -> Tensor:
    """first … last every .1 s, which every time step meets."""
    return torch.arange(round(10 * first), round(10 * last) + 1, dtype=torch.float64) / 10


def tip(track: Track) -> Tensor:
    """Far end of the chain's last link every .1 s of the first second, `[10, worlds, 3]`."""
    last = track.poses[track.at(tenths(1.0)), :, -1]
    return last[..., 3] + chains.LENGTH * last[..., 0]


def landing(track: Track) -> Tensor:
    """Centre of mass at .4 s, `[1, worlds, 3]`: .08 s after the first touch."""
    return track.center[track.at(tenths(0.4, 0.4))]


def slid(track: Track) -> Tensor:
    """How far the centre of mass has gone down the slope, `[worlds, 1]`."""
    return (track.center[-1] - track.center[0])[:, :1]


def margin(track: Track) -> Tensor:
    """x − x0 − ½ g (sin − μ cos) T² + μ (z − z0) of the centre of mass, from rest, `[worlds, 1]`: < 0: more friction than Coulomb's
    law allows, 0: it slides all the way, > 0: less friction, as where something sticks or moves sideways."""
    moved = track.center[-1] - track.center[0]
    free = 0.5 * chains.SLIDE * track.time[-1] ** 2
    return (moved[:, 0] - free + chains.SLOPE_FRICTION * moved[:, 2])[:, None]


def stopped(track: Track) -> Tensor:
    """How far the box has gone, `[worlds, 1]`."""
    return (track.q[-1] - track.q[0])[:, :1]


def middle_axis(track: Track) -> Tensor:
    """Direction of the axis that the body spins about, every .1 s of the first 2.5 s, `[25, worlds, 3]`: it turns over once."""
    return track.poses[track.at(tenths(2.5)), :, 0, :, 1]


def links(track: Track) -> Tensor:
    """Where the links are, in lengths of the chain, every .1 s for 2 s, `[20, worlds, 10, 3]`."""
    return track.poses[track.at(tenths(2.0))][..., 3] / (10 * chains.LENGTH)


def straight_links() -> Tensor:
    """`links` of the chain that turns as one body about its centre, `[20, 1, 10, 3]`."""
    time = tenths(2.0)[:, None, None]
    arm = chains.LENGTH * (torch.arange(10, dtype=torch.float64) - 5)
    middle, angle = 5.0 * time + 5 * chains.LENGTH, 10.0 * time
    place = (middle + arm * torch.cos(angle), torch.zeros_like(arm) * time, -arm * torch.sin(angle))
    return torch.stack(place, -1) / (10 * chains.LENGTH)


def root(track: Track) -> Tensor:
    """Where the first link is, every .1 s of the first half second, `[5, worlds, 3]`: deviations grow tenfold every .4 s."""
    return track.poses[track.at(tenths(0.5)), :, 0, :, 3]


def swing(count: int, size: float) -> Callable[[Tensor], Tensor]:
    """Control of `count` motors by sines of 1 Hz, each a radian ahead of the one before, `size` of their full range."""
    ahead = torch.arange(count, dtype=torch.float64)
    return lambda time: size * torch.sin(2 * math.pi * time[..., None] + ahead)


OWN = "each simulator itself, at a fine step"
_CASES = (
    Case("chain-fixed", "B: tip, 1 s", "m", 1.0, (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6), tip, lambda: chain_tips(10)[:, None],
         "Lagrange's equations by Runge–Kutta 4 at .1 ms"),
    Case("chain-ground", "C: centre of mass at .4 s", "m", 2.0, (3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4), landing, None, OWN, 0.005,
         0.4, numbers=("energy_gain_J", "energy_gain", "penetration_m")),
    Case("chain-slope", "D1: distance in 10 s", "m", 10.0, (1e-1, 1e-3, 1e-6), slid,
         lambda: torch.full((1, 1), 50 * chains.SLIDE, dtype=torch.float64), "½ g (sin − μ cos) T²", 0.01,
         numbers=("energy_gain_J", "energy_gain", "penetration_m")),
    Case("chain-slope-drop", "D2: Coulomb margin, 5 s", "m", 5.0, (1e-1, 1e-3, 1e-6), margin,
         lambda: torch.zeros(1, 1, dtype=torch.float64), "0: it slides all the way", 0.01,
         numbers=("energy_gain_J", "energy_gain", "penetration_m")),
    Case("box-slide", "A: stopping distances", "m", 1.5, (1e-2, 1e-3, 1e-4, 1e-5, 1e-6), stopped,
         lambda: 0.5 / boxes.GRAVITY / torch.tensor(boxes.SLIDING_FRICTION, dtype=torch.float64)[:, None],
         "v²/(2 μ g), μ = .1, .2, .3, .5, .8", 0.005, numbers=("energy_gain_J", "energy_gain", "penetration_m")),
    Case("dzhanibekov", "F2: spin axis, 2.5 s", "rad", 10.0, (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6), middle_axis,
         lambda: middle_axes(25)[:, None], "Euler's equations by Runge–Kutta 4 at .1 ms", 0.01,
         numbers=("energy_gain_J", "energy_gain", "energy_drift", "angular_momentum_drift")),
    Case("chain-free", "F4: links, 2 s", "chain lengths", 2.0, (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6), links, straight_links,
         "a rigid rotation: the chain stays straight", 0.005,
         numbers=("energy_gain_J", "energy_gain", "energy_drift", "linear_momentum_drift", "angular_momentum_drift")),
    Case("hopper", "hopper: root, .5 s", "m", 1.0, (1e-2, 3e-3, 1e-3, 3e-4, 1e-4), root, None, OWN, 0.005, 0.5, swing(3, 0.1), ()),
    Case("walker", "walker: root, .5 s", "m", 1.0, (1e-2, 3e-3, 1e-3, 3e-4, 1e-4), root, None, OWN, 0.005, 0.5, swing(6, 0.1), ()),
)  # fmt: skip
CASES: Mapping[str, Case] = {case.scene: case for case in _CASES}
