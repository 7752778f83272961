"""Derivatives of whole steps against central differences: by everything that a step depends on, each along a random direction.

All differences of all quantities are worlds of one batch. Poses and axes move on their manifolds, everything else in a straight
line.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from pbfd_torch import Simulator
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.tree.kinematics import difference, retract
from pbfd_torch.tree.rotations import quaternion_exp, quaternion_matrix
from tests.finite_differences import derivative
from tests.random_trees import generator

POSES = ("joint_frame", "link_frame", "carrier.start")
AXES = ("joint_axis", "normal", "normals")
FLOOR = 1e-3  # the end is of the size of 1, and so are its largest derivatives
FORMS = (".form", ".axis")  # of curved candidates: those among them that are points have none to be differentiated by
SHARED = (".normals", ".offsets", ".starts", ".ends", ".coefficients", ".origin", ".spacing")
PRECISE = Fallbacks.within(1e-13)  # of the weight: differences see the solver's tolerance

# what depends on the energy gained so far would jump within the differences
SMOOTH: dict[str, Callable[[], Integrator[Any]]] = {**INTEGRATORS, "energy-momentum": partial(EnergyMomentum, math.inf)}


def kind(name: str) -> str:
    """What a parameter is, by its name."""
    parts = name.split(".")
    return "carrier.start" if parts[-2:] == ["carrier", "start"] else parts[-1]


@dataclass(frozen=True, eq=False)
class Experiment:
    """Some steps from a configuration and a velocity, and a random linear function of where they end.

    Attributes:
        scene, dt, integrator: what steps.
        q, v: `[nq]`, `[nv]`. control: `[nu]` or None.
        steps: how many.
    """

    scene: Scene
    dt: float
    integrator: Callable[[], Integrator[Any]]
    q: Tensor
    v: Tensor
    control: Tensor | None = None
    steps: int = 2

    @property
    def values(self) -> dict[str, Tensor]:
        """Everything that the end depends on smoothly, by name. Radii of candidates that are all points are left out: with the
        first radius above zero they begin to roll; and so are the tables of hulls and grids, which all worlds share."""
        own = {"q": self.q, "v": self.v, "dt": torch.tensor(self.dt, dtype=self.q.dtype)}
        if self.control is not None and self.control.numel():
            own["control"] = self.control
        found = {name: x for name, x in parameters(self.scene).items() if x.numel()}
        limits = any(isinstance(term, JointLimits) for term in self.scene.terms)
        for name, x in found.items():
            if name.endswith((".lower", ".upper")) and not limits:
                continue
            if name.endswith((*SHARED, *FORMS)) or (name.endswith("1.radius") and not bool((x > 0).any())):
                continue
            own[name] = x
        return own

    def end(self, values: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """A number `[*batch]` that depends on the last state, and the statuses of all steps `[steps, *batch]`."""
        own = ("q", "v", "dt", "control")
        scene = with_parameters(self.scene, {name: x for name, x in values.items() if name not in own})
        q, v, dt, control = (values.get(name, getattr(self, name)) for name in own)
        many = isinstance(dt, Tensor) and dt.ndim > 0
        simulator = Simulator(scene, self.dt if many else dt, self.integrator(), PRECISE)
        if many:
            simulator = simulator.sized(dt)
        state = simulator.initial_state(q, v, control)
        status = []
        for _ in range(self.steps):
            state, solution = simulator.step(state, control)
            status.append(solution.status)
        a = scene.articulation
        random = generator(5)
        wq, wv = (torch.randn(a.nv, dtype=q.dtype, generator=random) for _ in range(2))
        velocity = simulator.integrator.velocity(a, state, simulator.step_size)
        reached = difference(a, self.q.expand_as(state.q), state.q)
        return (wq * reached).sum(-1) + (wv * self.dt * velocity).sum(-1), torch.stack(status)

    def directions(self, seed: int = 0) -> dict[str, Tensor]:
        """How each value is to be moved; of the size of the value itself."""
        random = generator(seed)
        found = {}
        for name, value in self.values.items():
            last = kind(name)
            shape = tuple(value.shape)
            if name == "q" or last == "rest":
                shape = (self.scene.articulation.nv,)
            elif last in POSES:
                shape = (*value.shape[:-2], 6)
            noise = torch.randn(shape, dtype=value.dtype, generator=random)
            if last in POSES or last in AXES or name == "q" or last == "rest":
                found[name] = 0.1 * noise
            elif last == "pseudo_inertia":
                found[name] = 0.1 * value * 0.5 * (noise + noise.mT)
            elif name in ("v", "control", "gravity"):
                found[name] = (10 if name == "gravity" else 1) * noise
            elif last.endswith("_range") or last in ("lower", "upper"):
                found[name] = torch.where(torch.isfinite(value), 0.1 * noise, torch.zeros_like(value))
            else:
                size = value.abs().clamp_min(1e-3)
                found[name] = size * noise if value.ndim else 0.3 * size
                if last == "torque":  # none may be negative: what is zero stays so
                    found[name] = torch.where(value == 0, 0.0, found[name])
            if name.startswith("terms") and shape == tuple(value.shape) == (
                self.scene.articulation.nv,
            ):  # one number for all axes of a rotation
                rows = self.scene.articulation.topology.turning_v
                found[name][rows] = found[name][rows[:, :1]].expand_as(rows) * (value[rows] != 0)
        return found

    def moved(self, name: str, direction: Tensor, t: Tensor) -> Tensor:
        """The value at t `[*]` along its path."""
        value, last = self.values[name], kind(name)
        step = t[(..., *(None,) * direction.ndim)] * direction
        if name == "q" or last == "rest":
            return retract(self.scene.articulation, value.expand(*step.shape[:-1], -1), step)
        if last in POSES:
            turned = value[..., :3, :3] @ quaternion_matrix(quaternion_exp(step[..., :3]))
            top = torch.cat((turned, value[..., :3, 3:] + step[..., 3:, None]), -1)
            return torch.cat((top, value[..., 3:, :].expand(*top.shape[:-2], 1, 4)), -2)
        if last in AXES:
            return (quaternion_matrix(quaternion_exp(step)) @ value[..., None]).squeeze(-1)
        return value + step


@dataclass(frozen=True)
class Found:
    """A derivative along one direction: by the implicit function theorem, and by differences. `same`: whether all steps of the
    differences were made in the same way."""

    implicit: float
    differences: float
    same: bool

    @property
    def error(self) -> float:
        """Relative; derivatives count as `FLOOR` at least."""
        return abs(self.implicit - self.differences) / max(abs(self.differences), FLOOR)


def compared(
    experiment: Experiment, largest: float = 1e-2, levels: int = 10, names: tuple[str, ...] | None = None
) -> dict[str, Found]:
    """The derivative by every value along a random direction."""
    directions = experiment.directions()
    names = tuple(directions) if names is None else names
    at = torch.zeros(len(names), dtype=experiment.q.dtype, requires_grad=True)
    values = {name: experiment.moved(name, directions[name], at[k]) for k, name in enumerate(names)}
    values = {name: x[None] if name in ("q", "v", "control") else x for name, x in values.items()}
    end, _ = experiment.end(values)
    (implicit,) = torch.autograd.grad(end.sum(), at)

    statuses: list[Tensor] = []
    own = torch.eye(len(names), dtype=experiment.q.dtype)

    def moved(t: Tensor) -> Tensor:
        """`[m, len(names), 1]` → `[m, len(names)]`: every name has worlds of its own, in which only it moves."""
        worlds = {"q": experiment.q.expand(*t.shape[:-1], -1)}
        for k, name in enumerate(names):
            worlds[name] = _per_world(experiment, name, experiment.moved(name, directions[name], t[..., 0] * own[k]))
        found, status = experiment.end(worlds)
        statuses.append(status)
        return found

    with torch.no_grad():
        differences = derivative(moved, 1, (len(names),), largest=largest, levels=levels)
    (status,) = statuses
    same = (status == status[:, :1]).all(0).all(0)
    return {
        name: Found(float(a), float(b), bool(c))
        for name, a, b, c in zip(names, implicit, differences.squeeze(-1), same, strict=True)
    }


def _per_world(experiment: Experiment, name: str, value: Tensor) -> Tensor:
    """A number per world as those that take one per candidate have it."""
    own = experiment.values[name].ndim
    if name.endswith("normal"):  # of planes, one for all candidates
        return value[..., None, :]
    return value[..., None] if own == 0 and name != "dt" else value
