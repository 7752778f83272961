"""Builds the record of a rollout, step by step."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import center_of_mass, kinetic_energy, momentum, rotor_energy
from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.integrators.integrator import Integrator, State
from pbfd_torch.records.depiction import depicted
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.load import Hazardous
from pbfd_torch.tree.kinematics import Placement, place


class Records:
    """One entry per step and quantity; `finish` stacks them."""

    def __init__(self, scene: Scene, dt: float, began: Tensor) -> None:
        """began: when `[*batch]` [s]."""
        self._scene, self._dt, self._began = scene, dt, began
        self._entries: dict[str, list[Tensor]] = {}
        self.steps = 0
        self._lanes = 0

    def _begin(self, start: dict[str, Tensor]) -> None:
        """The state at the start."""
        for name, value in start.items():
            self._entries[name] = [value[None]]

    def _add(self, solution: Solution, entries: dict[str, Tensor]) -> None:
        """One step: an interruption before this leaves the record as it was."""
        solved = {
            "status": solution.status,
            "iterations": solution.iterations,
            "evaluations": solution.evaluations,
            "residual_norm": solution.residual_norm,
            "fallbacks": solution.fallbacks,
            "substeps": torch.ones_like(solution.status) if solution.steps is None else solution.steps,
        }
        for name, value in (entries | solved).items():
            self._entries.setdefault(name, []).append(value[None])
        self.steps += 1
        self._lanes += solution.lanes

    def _seen(self, placement: Placement, v: Tensor, rates: Tensor, stored: Tensor) -> dict[str, Tensor]:
        """A state: placement and velocity v `[*batch, nv]`, the links' rates, and the potential energy [J] `[*batch]`."""
        scene = self._scene
        linear, angular = momentum(placement, rates)
        return {
            "q": placement.q,
            "v": v,
            "link_poses": placement.poses[..., :3, :],
            "center_of_mass": center_of_mass(placement),
            "kinetic_energy": kinetic_energy(scene.articulation, rates) + rotor_energy(scene.articulation, v, scene.terms),
            "potential_energy": stored,
            "linear_momentum": linear,
            "angular_momentum": angular,
        }

    def finish(self, lanes: int | None = None) -> Rollout:
        """The record so far; lanes: what the schedule spent, where the steps themselves do not know it."""
        stacked = {name: torch.cat(_alike(values)) for name, values in self._entries.items()}
        if "contact_depth" not in stacked:
            like = stacked["q"]
            empty = like.new_zeros((self.steps, *like.shape[1:-1], 0))
            stacked |= dict.fromkeys(_CONTACT, empty[..., None].expand(*empty.shape, 3)) | {"contact_depth": empty}
        spent = self._lanes if lanes is None else lanes
        return assembled(self._scene, self._dt, self._began, spent, stacked)


def assembled(scene: Scene, dt: float, began: Tensor, lanes: int, arrays: dict[str, Tensor]) -> Rollout:
    """The rollout of all that is recorded at each step from a time `[*batch]` on; the rest is the scene's."""
    like, a = arrays["q"], scene.articulation
    time = dt * torch.arange(len(like), dtype=like.dtype, device=like.device)
    return Rollout(
        scene_name=scene.name,
        dt=dt,
        link_names=a.link_names,
        joint_names=a.joint_names,
        dangers=tuple(x for term in scene.terms if isinstance(term, Hazardous) for x in term.dangers(a)),
        lanes=torch.tensor(lanes),
        appearance=depicted(scene),
        time=time,
        obstacle_poses=_obstacle_poses(scene, time.reshape(-1, *(1 for _ in began.shape)) + began),
        **arrays,
    )


def _obstacle_poses(scene: Scene, time: Tensor) -> Tensor:
    """See `Rollout`; time: `[steps + 1, *batch]`."""
    a, obstacles = scene.articulation, scene.obstacles
    when = time if any(x.motion.moves for x in obstacles) else time[:1]
    shape = when.shape
    poses = [time.new_zeros((*shape, 0, 3, 4))]
    for obstacle in obstacles:
        carrier = obstacle.carrier(a.dtype, a.device)
        pose = torch.eye(4, dtype=a.dtype, device=a.device) if carrier is None else carrier.pose(when)
        poses.append(pose[..., None, :3, :].expand(*shape, 1, 3, 4))
    return torch.cat(poses, -3)


def least_bytes(scene: Scene, worlds: int, steps: int) -> int:
    """What the record of so many steps takes at least while it is finished: everything twice, contacts left out."""
    a = scene.articulation
    reals = a.nq + a.nv + 12 * (a.nlink + len(scene.obstacles)) + 12
    counts = 10
    return 2 * worlds * steps * (reals * a.dtype.itemsize + counts * torch.int32.itemsize)


class Recorder(Records):
    """The record of a `Simulator`."""

    def __init__(self, scene: Scene, integrator: Integrator[Any], dt: float, step_size: Tensor, state: State) -> None:
        super().__init__(scene, dt, state.time)
        self._step_size = step_size.detach()
        self._integrator = integrator
        self._begin(self._state(state, place(scene.articulation, state.q)))

    def _state(self, state: State, placement: Placement) -> dict[str, Tensor]:
        scene = self._scene
        a = scene.articulation
        v = self._integrator.velocity(a, state, self._step_size)
        rates = self._integrator.pose_rates(a, state, self._step_size)
        return self._seen(placement, v, rates, scene.potential_energy(placement, state.time))

    def record(self, state: State, solution: Solution, objective: BalanceObjective) -> None:
        """One solved step: the state after it, how it was solved, and its contacts."""
        self._add(solution, self._step(state, objective))

    def _step(self, state: State, objective: BalanceObjective) -> dict[str, Tensor]:
        placement = place(self._scene.articulation, state.q)
        entries = self._state(state, placement) | {"hazards": state.hazards, "suspect": self._suspect(state, objective, placement)}
        pairs = zip(objective.terms, objective.prepared, strict=True)
        contacts = [(term, prepared) for term, prepared in pairs if isinstance(term, Contact | BodyContact)]
        points = [term.points(prepared, placement) for term, prepared in contacts]
        if points:
            entries["contact_depth"] = torch.cat([x.depth for x in points], -1)
            for name in _CONTACT:
                entries[name] = torch.cat([getattr(x, name.removeprefix("contact_")) for x in points], -2)
        return entries

    def _suspect(self, state: State, objective: BalanceObjective, placement: Placement) -> Tensor:
        """Of the worlds whose step has a hazard what is deepest beyond its measure, `[*batch]`; see `Rollout`."""
        none = torch.full_like(state.hazards, -1)
        shares, numbers, count, turned = [], [], 0, objective.turned(placement)
        for term, prepared in zip(objective.terms, objective.prepared, strict=True):
            if isinstance(term, Hazardous):
                share, number = term.strain(prepared, placement, turned)
                shares.append(share)
                numbers.append(number + count)
                count += len(term.dangers(objective.articulation))
        if count == 0:
            return none
        worst = torch.cat(shares, -1).argmax(-1, keepdim=True)
        found = torch.cat(numbers, -1).gather(-1, worst).squeeze(-1)
        return torch.where(state.hazards != 0, found.to(none.dtype), none)


_CONTACT = ("contact_point", "contact_normal", "contact_force", "contact_slip")


def _alike(values: list[Tensor]) -> list[Tensor]:
    """The same values, those of contacts with as many slots as the step with the most of them: the number may grow."""
    most = [max(sizes) for sizes in zip(*(x.shape[1:] for x in values), strict=True)]
    return [_padded(x, [len(x), *most]) for x in values]


def _padded(value: Tensor, shape: list[int]) -> Tensor:
    missing = [(0, full - size) for size, full in zip(value.shape, shape, strict=True)]
    if not any(after for _, after in missing):
        return value
    return torch.nn.functional.pad(value, [x for pair in reversed(missing) for x in pair])
