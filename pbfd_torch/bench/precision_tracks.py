"""A motion as every simulator gives it, and the numbers that are read off it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import center_of_mass, kinetic_energy, momentum, potential_energy, rotor_energy
from pbfd_torch.models import Setup
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact import Contact
from pbfd_torch.tree.kinematics import Motion, place


@dataclass(frozen=True, eq=False)
class Track:
    """What is seen of a motion, at the start and after every step, `T + 1` times in all. SI units, world coordinates.

    Attributes:
        time: `[T + 1]` [s].
        q, v: `[T + 1, worlds, nq]`, `[T + 1, worlds, nv]`.
        poses: `[T + 1, worlds, nlink, 3, 4]` [R | t] of the links.
        center: `[T + 1, worlds, 3]` centre of mass.
        kinetic, energy: `[T + 1, worlds]` [J], the latter with what is stored.
        linear, angular: `[T + 1, worlds, 3]` momentum, the latter about the centre of mass.
        depth: `[T + 1, worlds]` deepest penetration [m], 0 where nothing touches.
    """

    time: Tensor
    q: Tensor
    v: Tensor
    poses: Tensor
    center: Tensor
    kinetic: Tensor
    energy: Tensor
    linear: Tensor
    angular: Tensor
    depth: Tensor

    @staticmethod
    def of_states(scene: Scene, time: Tensor, q: Tensor, v: Tensor) -> Track:
        """A motion that is known by its states alone; its contacts hold no energy."""
        a = scene.articulation
        placement = place(a, q)
        rates = Motion(placement, v).rates
        linear, angular = momentum(placement, rates)
        kinetic = kinetic_energy(a, rates) + rotor_energy(a, v, scene.terms)
        depths = [term.depth(placement).amax(-1) for term in scene.terms if isinstance(term, Contact)]
        return Track(
            time=time,
            q=q,
            v=v,
            poses=placement.poses[..., :3, :],
            center=center_of_mass(placement),
            kinetic=kinetic,
            energy=kinetic + potential_energy(placement, scene.gravity),
            linear=linear,
            angular=angular,
            depth=torch.stack(depths).amax(0).clamp_min(0) if depths else torch.zeros_like(q[..., 0]),
        )

    @staticmethod
    def of_rollout(setup: Setup, rollout: Rollout) -> Track:
        """Ours. The start is the setup's own: a rollout has the velocity of the virtual step before it there."""
        start = Track.of_states(setup.scene, rollout.time[:1], setup.q[None], setup.v[None])

        def joined(first: Tensor, rest: Tensor) -> Tensor:
            return torch.cat((first, rest[1:]))

        energy = setup.scene.energy(setup.q, setup.v)[None]
        return Track(
            time=rollout.time,
            q=rollout.q,
            v=joined(start.v, rollout.v),
            poses=rollout.link_poses,
            center=rollout.center_of_mass,
            kinetic=joined(start.kinetic, rollout.kinetic_energy),
            energy=joined(energy, rollout.energy),
            linear=joined(start.linear, rollout.linear_momentum),
            angular=joined(start.angular, rollout.angular_momentum),
            depth=torch.cat((start.depth, rollout.penetration)),
        )

    @property
    def dt(self) -> float:
        """Time step [s]."""
        return float(self.time[1] - self.time[0])

    def at(self, times: Tensor) -> Tensor:
        """Positions in the track of the times `[n]` [s], which its steps must meet."""
        return (times / self.dt).round().long()

    def numbers(self) -> dict[str, float]:
        """What is told of every motion; NaN where it is not finite."""
        drift = self.energy - self.energy[:1]
        return {
            "energy_gain_J": float(drift.amax()),
            "energy_gain": float(drift.amax() / self.kinetic.amax()),  # over the largest kinetic energy
            "energy_drift": _drift(drift[-1:], self.energy),
            "linear_momentum_drift": _drift(self.linear - self.linear[:1], self.linear),
            "angular_momentum_drift": _drift(self.angular - self.angular[:1], self.angular),
            "penetration_m": float(self.depth.amax()),
        }


def _drift(change: Tensor, values: Tensor) -> float:
    """The largest entry of a change over the largest at the start; NaN where it starts at zero."""
    start = values[0].abs().amax()
    return float(change.abs().amax() / torch.where(start > 1e-12, start, torch.nan))


def rms(difference: Tensor) -> float:
    """Root of the mean square length of vectors `[..., n]`."""
    return float((difference * difference).sum(-1).mean().sqrt())
