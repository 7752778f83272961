"""A scene as the C++ core sees it: index tables and numbers, in the order in which src/plan.h reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.contact.surface import Plane
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.fitted import Fitted
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.stepping.stepper import SHORTEST_STEP
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, JointKind, force_scale, reach

KINDS = {(1, 1): 0, JointKind.BALL.value[:2]: 2, JointKind.FREE.value[:2]: 3}  # slides are 1, as src/plan.h has them
TERMS = (Inertia, JointSprings, JointDamping, Armature, JointDryFriction, JointLimits, Actuators, Contact)


class NotCompiledError(Exception):
    """What the core does not know, in words."""


def _unknown(what: str) -> NotCompiledError:
    return NotCompiledError(f"the core does not know {what}")


@dataclass(frozen=True, eq=False)
class Plan:
    """sizes: nodes, nq, nv, nu, candidates, halvings. whole: `int32`. real: of the scene's dtype."""

    sizes: tuple[int, int, int, int, int, int]
    whole: Tensor
    real: Tensor


def planned(stepper: EagerStepper[Any]) -> Plan:
    """The plan of a stepper's scene. Raises `NotCompiledError` naming what the core does not know."""
    a = stepper.articulation
    _require_covered(stepper)
    known = _Terms(stepper)
    t = a.topology
    kinds = [int(not hinge) if size == (1, 1) else KINDS[size] for size, hinge in zip(t.joint_sizes, t.joint_is_hinge, strict=True)]
    whole = [parent - 1 for parent in t.joint_parent] + kinds + [*t.q_start, *t.v_start]
    act, candidates = known.actuators, known.candidates
    nu = 0
    driven: list[Tensor] = []
    if act is not None:
        nu = act.nu
        whole += act.coordinate.tolist() + act.dof.tolist()
        ranges = [*act.control_range.unbind(-1), *act.force_range.unbind(-1)]
        driven = [act.gear, act.gain, act.bias, act.stiffness, act.damping, *ranges]
    whole += candidates.nodes
    scale = force_scale(a, 1.0).expand(t.nv)
    shares = _shares(stepper, known.share)
    speeds = [known.release, known.slip_speed, known.limit_release, known.dry_speed]
    real = [
        *_nodes(a),
        *(stepper.scale.expand(t.nv), scale, t.turns.to(a.dtype), *shares, known.spring, known.damping, known.armature),
        *(known.dry, a.lower, a.upper, known.limit, known.rest),
        *driven,
        *candidates.numbers(a),
        *(stepper.scene.gravity, reach(a), a.rest.new_tensor(speeds)),
    ]
    flat = torch.cat([torch.as_tensor(x, dtype=a.dtype).reshape(-1) for x in real]).contiguous()
    sizes = (t.njoint, t.nq, t.nv, nu, len(candidates.nodes), len(shares) - 1)
    return Plan(sizes, torch.tensor(whole, dtype=torch.int32), flat)


def _require_covered(stepper: EagerStepper[Any]) -> None:
    """Raises `NotCompiledError` for what is not the terms' affair."""
    a, scene = stepper.articulation, stepper.scene
    if a.device.type != "cpu":
        raise _unknown(f"device {a.device.type}")
    if type(stepper.integrator) not in (EnergyMomentum, ImplicitEuler):
        raise _unknown(f"integrator {type(stepper.integrator).__name__}")
    if stepper.step_size.ndim:
        raise _unknown("a step of its own for each world")
    if not isinstance(stepper.evaluations, int):
        raise _unknown("evaluations of its own for each world")
    for what in ("joint_frame", "joint_axis", "joint_ref", "link_frame", "pseudo_inertia", "lower", "upper"):
        if getattr(a, what).ndim != {"joint_ref": 1, "lower": 1, "upper": 1, "joint_axis": 2}.get(what, 3):
            raise _unknown(f"{what} of its own for each world")
    if scene.gravity.ndim != 1:
        raise _unknown("gravity of its own for each world")
    free = [j for j, size in enumerate(a.topology.joint_sizes) if size == (7, 6)]
    eye = torch.eye(4, dtype=a.dtype)
    if any(not torch.equal(a.joint_frame[j], eye) for j in free):
        raise _unknown("a free joint that does not move along the world's axes")


def _shares(stepper: EagerStepper[Any], share: Tensor) -> list[Tensor]:
    """θ of the smooth loads on joints in the whole step, where it is `share`, and in steps ½, ¼, … as long: as many as its halvings
    may make."""
    shares = [share]
    for times in range(1, stepper.halvings + 1):
        if stepper.dt / 2**times < SHORTEST_STEP:
            break
        terms = stepper.integrator.adapted(stepper.articulation, stepper.scene.terms, stepper.step_size / 2**times)
        shares.append(next((term.share for term in terms if isinstance(term, Fitted)), share))
    return shares


def _nodes(a: Articulation) -> Sequence[Tensor]:
    """Frames, axes and references of the joints, and masses, centres and second moments of all links that ride on each."""
    t = a.topology
    ridden = torch.zeros(t.njoint, 4, 4, dtype=a.dtype)
    for link, node in enumerate(t.link_node):
        if node > 0:  # what rides on the world does not move
            ridden[node - 1] += a.link_frame[link] @ a.pseudo_inertia[link] @ a.link_frame[link].mT
    mass, first = ridden[:, 3, 3], ridden[:, :3, 3]
    center = torch.where(mass[:, None] > 0, first / torch.where(mass > 0, mass, 1.0)[:, None], 0.0)
    second = ridden[:, :3, :3] - mass[:, None, None] * center[:, :, None] * center[:, None, :]
    return a.joint_frame[:, :3, :3], a.joint_frame[:, :3, 3], a.joint_axis, a.joint_ref, mass, center, second


@dataclass
class _Candidates:
    """Of all contacts with half-spaces."""

    nodes: list[int] = field(default_factory=list)
    rows: list[tuple[Tensor, ...]] = field(default_factory=list)  # of each contact, what `numbers` gives of all

    def numbers(self, a: Articulation) -> Sequence[Tensor]:
        """Positions, radii, margins, C⊥, μ, normals, offsets, and from which depth on they are a hazard."""
        if not self.rows:
            return ()
        return [torch.cat([x.to(a.dtype) for x in column]) for column in zip(*self.rows, strict=True)]


class _Terms:
    """The numbers of a stepper's terms, of those that are there; the others do nothing."""

    def __init__(self, stepper: EagerStepper[Any]) -> None:
        a = stepper.articulation
        zero = torch.zeros(a.nv, dtype=a.dtype)
        self.share = zero + (0.5 if isinstance(stepper.integrator, EnergyMomentum) else 1.0)
        self.spring = self.damping = self.armature = self.dry = self.limit = zero
        self.rest = a.rest
        self.release, self.slip_speed, self.limit_release, self.dry_speed = 0.1, 1e-3, 1.0, 1e-3
        self.actuators: Actuators | None = None
        self.candidates = _Candidates()
        self._speeds: set[tuple[float, float]] = set()
        seen: set[type] = set()
        for term in stepper.terms:
            inner: Any = term
            if isinstance(term, Fitted):
                self.share, inner = term.share, term.term
            kind = type(inner)
            if kind not in TERMS:
                raise _unknown(kind.__name__)
            if kind in seen and kind is not Contact:
                raise _unknown(f"two terms {kind.__name__}")
            seen.add(kind)
            self._take(a, inner)
        if any(x.ndim != 1 for x in (self.share, self.spring, self.damping, self.armature, self.dry, self.limit, self.rest)):
            raise _unknown("parameters of joints of their own for each world")

    def _take(self, a: Articulation, term: Any) -> None:
        match term:
            case JointSprings():
                self.spring, self.rest = term.stiffness, term.rest
            case JointDamping():
                self.damping = term.damping / self.share  # `taken_at` has multiplied it
            case Armature():
                self.armature = term.inertia
            case JointDryFriction():
                self.dry, self.dry_speed = term.torque, term.slip_speed
            case JointLimits():
                if term.drives is not None:
                    raise _unknown("limits that actuators without a largest force press on")
                self.limit, self.limit_release = term.share * term.stiffness, term.release
            case Actuators():
                if term.gear.ndim != 1:
                    raise _unknown("actuators of their own for each world")
                self.actuators = term
            case Contact():
                self._touch(a, term)

    def _touch(self, a: Articulation, term: Contact) -> None:
        law, friction, name = term.normal_force, term.friction, term.pairs[0][1] if term.pairs else "the ground"
        if type(term.surface) is not Plane or term.carrier is not None:
            raise _unknown(f"contact with '{name}', which is no half-space at rest")
        if type(law) is not NormalForce or law.exponent != 2.0:
            raise _unknown(f"normal force on '{name}' with another exponent than 2")
        if type(friction) is not CoulombFriction and friction is not None:
            raise _unknown(type(friction).__name__)
        if term.restitution is not None:
            raise _unknown("restitution")
        count = len(term.link)
        slip = self.slip_speed if friction is None else friction.slip_speed
        self._speeds.add((law.release, slip))
        if len(self._speeds) > 1:
            raise _unknown("contacts with different release or slip speeds")
        self.release, self.slip_speed = law.release, slip

        def each(value: float | Tensor | None, other: float) -> Tensor:
            number = torch.as_tensor(other if value is None else value, dtype=a.dtype)
            if number.ndim > 1:
                raise _unknown(f"contact with '{name}' of its own for each world")
            return number.expand(count)

        nodes = [a.topology.link_node[link] for link in term.link.tolist()]
        moving = torch.tensor([i for i, node in enumerate(nodes) if node > 0])
        if len(moving) == 0:
            return
        if term.position.ndim != 2 or term.radius.ndim != 1 or term.margin.ndim != 1:
            raise _unknown(f"contact with '{name}' of its own for each world")
        frame = a.link_frame[term.link]
        position = (frame[:, :3, :3] @ term.position[..., None]).squeeze(-1) + frame[:, :3, 3]
        mu = each(None if friction is None else friction.mu, 0.0) * each(term.grip, 1.0)
        stiffness = each(law.stiffness, 0.0) * each(term.firm, 1.0)
        normal, offset = term.surface.normal.expand(count, 3), term.surface.offset.expand(count)
        deep = each(term.deep, torch.finfo(a.dtype).max)
        rows = (position, term.radius, term.margin, stiffness, mu, normal, offset, deep)
        self.candidates.nodes += [nodes[i] - 1 for i in moving.tolist()]
        self.candidates.rows.append(tuple(x[moving] for x in rows))
