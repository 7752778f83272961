"""What slides at a state, how fast, and what its friction has given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import mass_matrix
from pbfd_torch.contact.obstacle import Carrier
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.linear import solved_positive
from pbfd_torch.stepping.stepper import Stepper
from pbfd_torch.tensors.vectors import dot, outer, rows
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.body_contact import BodyContact, PreparedBodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.load import StepContext, Term
from pbfd_torch.terms.static_friction import StaticFriction
from pbfd_torch.terms.touching import Touching, shifting
from pbfd_torch.tree.articulation import reach
from pbfd_torch.tree.kinematics import link_jacobians, place

INSTANT = 0.4  # power of the rounding error that is the time [s] over which solids are seen to move


def _sliding_terms(terms: Sequence[Term]) -> list[tuple[Contact | BodyContact, float]]:
    """The contacts whose friction fades below a slip speed, and that speed [m/s]; those of bodies with obstacles that move left
    out."""
    found: list[tuple[Contact | BodyContact, float]] = []
    for term in terms:
        if isinstance(term, BodyContact) and any(map(_moves, term.obstacles)):
            continue
        if isinstance(term, Contact | BodyContact) and isinstance(term.friction, CoulombFriction | StaticFriction):
            found.append((term, term.friction.slip_speed))
    return found


def _moves(carrier: Carrier | None) -> bool:
    return carrier is not None and (carrier.motion.moves or any(carrier.motion.belt))


def may_slide(scene: Scene, state: Velocities, slowest: float) -> Tensor | None:
    """Worlds that move fast enough for a contact to slide at `slowest` slip speeds, by a look at their velocities alone, `[*batch]`
    bool; None: no contact has friction that could tell."""
    terms = _sliding_terms(scene.terms)
    if not terms:
        return None
    if any(isinstance(term, Contact) and _moves(term.carrier) for term, _ in terms):
        return torch.ones_like(state.time, dtype=torch.bool)
    # no contact slips faster than all coordinates move together, nor has it slid if they have not moved
    lever, slowest = reach(scene.articulation).clamp_min(1.0), slowest * min(speed for _, speed in terms)
    v = state.v + 0.5 * (state.steady + state.lag)
    return lever * torch.minimum(v.abs().sum(-1), state.average.abs().sum(-1)) > slowest


@dataclass(frozen=True, eq=False)
class Candidates:
    """Those of all contacts with friction at a state.

    Attributes:
        pressing: `[*batch, n]` bool.
        jacobian: `[*batch, n, 3, nv]` J with J v the velocity at which they slip [m/s] over solids that stand still.
        solid: `[*batch, n, 3]` what the solids add to it [m/s].
    """

    pressing: Tensor
    jacobian: Tensor
    solid: Tensor

    def slip(self, v: Tensor) -> Tensor:
        """The velocity at which they slip, `[*batch, n, 3]` [m/s], where the bodies move at v `[*batch, nv]`."""
        return (self.jacobian * v[..., None, None, :]).sum(-1) + self.solid


class Sliding:
    """The contacts with friction in the step of a stepper from a state under a control. Bodies touch at the same candidates all
    through it.

    `speed`: `[n]` the slip speed of the friction law of every candidate [m/s]; `start`: the candidates at the state."""

    def __init__(self, stepper: Stepper[Any], state: Velocities, control: Tensor | None) -> None:
        self._stepper, self._state, self._control = stepper, state, control
        self._size = stepper.step_size.expand(state.time.shape)
        self._terms = _sliding_terms(stepper.scene.terms)
        self._between: list[PreparedBodyContact | None] = [None] * len(self._terms)
        for k, (term, _) in enumerate(self._terms):
            if isinstance(term, BodyContact):
                self._between[k] = term.prepare(self._context(state, self._size))
        self.start, counts = self._candidates(state)
        speeds = [state.v.new_full((n,), speed) for (_, speed), n in zip(self._terms, counts, strict=True)]
        self.speed = torch.cat(speeds)

    def at(self, state: Velocities) -> tuple[Candidates, Tensor]:
        """The candidates at a state, and how they slip there `[*batch, n, 3]` [m/s]."""
        found, _ = self._candidates(state)
        return found, found.slip(self.velocity(state))

    def velocity(self, state: Velocities) -> Tensor:
        """That of a state, `[*batch, nv]`."""
        found: Tensor = self._stepper.integrator.velocity(self._stepper.scene.articulation, state, self._size)
        return found

    def stilled(self, there: Velocities, at: Tensor, which: Tensor) -> Velocities:
        """The state `there` after a step of `at` [s] `[*batch]` from the start, its velocity the same, but for what comes next the
        friction of some candidates `[*batch, n]` has given its impulse once for all, as an impact."""
        a, terms = self._stepper.scene.articulation, self._stepper.scene.terms
        start = self._stepper.integrator.resized(a, self._state, self._size, at)
        step, now = self._context(start, at), place(a, there.q)
        drags = []
        for (term, _), between in zip(self._terms, self._between, strict=True):
            if isinstance(term, Contact):
                force = term.force(term.prepare(step), now)
            else:
                assert between is not None
                force = term.force(replaced(between, dt=at[..., None]), now)
            assert force.drag is not None
            drags.append(-force.drag[..., None] * force.at.slip)
        found, _ = self._candidates(there)
        drag = torch.where(which[..., None], torch.cat(drags, -2), 0.0)
        impulse = at[..., None] * (drag[..., None] * found.jacobian).sum((-3, -2))
        given = solved_positive(mass_matrix(a, there.q, terms), impulse[..., None]).squeeze(-1)
        square = dot(there.push, there.push)
        share = (dot(there.steady, there.push) / torch.where(square > 0, square, 1.0))[..., None]
        return replaced(there, v=there.v + 0.5 * share * given, push=there.push - given, steady=there.steady - share * given)

    def _context(self, state: Velocities, dt: Tensor) -> StepContext:
        scene = self._stepper.scene
        return self._stepper.integrator.context(scene.articulation, state, dt, scene.gravity, self._control)

    def _candidates(self, state: Velocities) -> tuple[Candidates, list[int]]:
        """At a state, and how many each contact has."""
        instant = torch.full_like(self._size, torch.finfo(self._size.dtype).eps ** INSTANT)
        now = place(self._stepper.scene.articulation, state.q)
        # for so short a time nothing moves but the solids
        step = StepContext(
            dt=instant,
            previous=now,
            weight=1 / instant.square(),
            target_poses=now.poses,
            target_q=state.q,
            control=self._control,
            time=state.time,
            gravity=self._stepper.scene.gravity,
        )
        twists = link_jacobians(now)
        pressing, jacobians, solids = [], [], []
        for (term, _), between in zip(self._terms, self._between, strict=True):
            at: Touching
            if isinstance(term, Contact):
                at = term.touching(replaced(term, restitution=None).prepare(step), now)
                moves = twists[..., term.link, :, :]
                solids.append(at.slip / instant[..., None, None])
            else:
                assert between is not None
                at = term.touching(between, now)
                moves = _of_bodies(twists, between.slots.first) - _of_bodies(twists, between.slots.second)
                solids.append(torch.zeros_like(at.normal))
            moves = shifting(at.points) @ moves
            pressing.append(at.depth > 0)
            jacobians.append(moves - outer(at.normal, rows(at.normal, moves)))
        found = Candidates(torch.cat(pressing, -1), torch.cat(jacobians, -3), torch.cat(solids, -2))
        return found, [x.shape[-1] for x in pressing]


def _of_bodies(twists: Tensor, index: Tensor) -> Tensor:
    """Twists `[*batch, nlink, 6, nv]` of bodies `[*batch, n]`; zero for obstacles, which come after the links and stand still."""
    links = twists.shape[-3]
    found = twists.take_along_dim(index.clamp_max(links - 1)[..., None, None].expand(*index.shape, *twists.shape[-2:]), -3)
    return found * (index < links)[..., None, None].to(found.dtype)
