"""A scene as the C++ core sees it: index tables and numbers, in the order in which src/plan.h reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.integrators.bdf2 import Bdf2
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.fitted import Fitted
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.variational import Variational
from pbfd_torch.native.aligned import aligned
from pbfd_torch.native.four_poses import Seats
from pbfd_torch.native.not_compiled import unknown
from pbfd_torch.native.plan_contact import Candidates, on_nodes
from pbfd_torch.native.plane import Plane as MotionPlane
from pbfd_torch.native.plane import plane_of
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.stepping.stepper import SHORTEST_STEP
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import HELD, JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.tree.articulation import Articulation, JointKind, force_scale, reach

KINDS = {(1, 1): 0, JointKind.BALL.value[:2]: 2, JointKind.FREE.value[:2]: 3}  # slides are 1, as src/plan.h has them
CONTACTS = (Contact, CurvedContact)
TERMS = (Inertia, JointSprings, JointDamping, Armature, JointDryFriction, JointLimits, Actuators, Pushes, *CONTACTS)


@dataclass(frozen=True, eq=False)
class Plan:
    """sizes: nodes, nq, nv, nu, halvings, those of the candidates, pushes. whole: `[n]` `int32`. real: `[n]` of the scene's dtype.
    dimension: 2 where all moves in a plane. grip: μ of the candidates `[*batch, candidates]`, where worlds differ. order: where
    these are among those of all contact terms. anchors: how many each contact has, in the order of a state's memory. seats: where
    links are on the nodes."""

    sizes: tuple[int, ...]
    whole: Tensor
    real: Tensor
    dimension: int
    grip: Tensor | None
    order: tuple[int, ...]
    anchors: tuple[int, ...]
    seats: Seats


def planned(stepper: EagerStepper[Any]) -> Plan:
    """The plan of a stepper's scene, in a plane where it moves in one. Raises `NotCompiledError` naming what the core does not
    know."""
    _require_covered(stepper)
    a = aligned(stepper.articulation)
    known = _Terms(stepper, a)
    held = known.pushed or not known.candidates.flat or isinstance(stepper.integrator, Bdf2)  # of which the core knows space only
    return _written(stepper, a, known, None if held else plane_of(a, [stepper.scene.gravity, *known.candidates.normals]))


def planned_in_space(stepper: EagerStepper[Any]) -> Plan:
    """The plan of a scene that the core knows, in space."""
    a = aligned(stepper.articulation)
    return _written(stepper, a, _Terms(stepper, a), None)


def _written(stepper: EagerStepper[Any], a: Articulation, known: _Terms, plane: MotionPlane | None) -> Plan:
    t = a.topology
    kinds = [int(not hinge) if size == (1, 1) else KINDS[size] for size, hinge in zip(t.joint_sizes, t.joint_is_hinge, strict=True)]
    whole = [parent - 1 for parent in t.joint_parent] + kinds + [*t.q_start, *t.v_start]
    act, candidates = known.actuators, known.candidates
    nodes, gravity = _nodes(a), stepper.scene.gravity
    if plane is not None:
        nodes, candidates, gravity = plane.nodes(a, nodes), candidates.within(plane), gravity @ plane.basis
    whole += _plain(nodes[0]) + _above(a)
    nu = 0
    driven: list[Tensor] = []
    if act is not None:
        nu = act.nu
        whole += act.coordinate.tolist() + act.dof.tolist()
        ranges = [*act.control_range.unbind(-1), *act.force_range.unbind(-1)]
        driven = [act.gear, act.gain, act.bias, act.stiffness, act.damping, *ranges]
    whole += candidates.whole() + known.pushed
    scale = force_scale(a, 1.0).expand(t.nv)
    shares = _shares(stepper, known.share)
    speeds = [known.limit_release, known.limit_per_force, known.dry_speed]
    real = [
        *nodes,
        *(stepper.scale.expand(t.nv), scale, t.turns.to(a.dtype), *shares, known.spring, known.damping, known.armature),
        *(known.dry, a.lower, a.upper, known.limit, known.rest),
        *driven,
        *(gravity, reach(a), a.rest.new_tensor(speeds)),
        *candidates.real(),
        *(x[k] for k in range(2) for x in known.pushes),
    ]
    flat = torch.cat([torch.as_tensor(x, dtype=a.dtype).reshape(-1) for x in real]).contiguous()
    dimension = 3 if plane is None else 2
    sizes = (t.njoint, t.nq, t.nv, nu, len(shares) - 1, *candidates.sizes, len(known.pushed))
    whole_numbers = torch.tensor(whole, dtype=torch.int32)
    return Plan(sizes, whole_numbers, flat, dimension, candidates.grip, candidates.order, tuple(candidates.anchors), Seats.of(a))


def _require_covered(stepper: EagerStepper[Any]) -> None:
    """Raises `NotCompiledError` for what is not the terms' affair."""
    a, scene = stepper.articulation, stepper.scene
    if a.device.type != "cpu":
        raise unknown(f"device {a.device.type}")
    if type(stepper.integrator) not in (EnergyMomentum, ImplicitEuler, Variational, Bdf2):
        raise unknown(f"integrator {type(stepper.integrator).__name__}")
    if stepper.step_size.ndim:
        raise unknown("a step of its own for each world")
    if not isinstance(stepper.evaluations, int):
        raise unknown("evaluations of its own for each world")
    for what in ("joint_frame", "joint_axis", "joint_ref", "link_frame", "pseudo_inertia", "lower", "upper"):
        if getattr(a, what).ndim != {"joint_ref": 1, "lower": 1, "upper": 1, "joint_axis": 2}.get(what, 3):
            raise unknown(f"{what} of its own for each world")
    if scene.gravity.ndim != 1:
        raise unknown("gravity of its own for each world")
    free = [j for j, size in enumerate(a.topology.joint_sizes) if size == (7, 6)]
    eye = torch.eye(4, dtype=a.dtype)
    if any(not torch.equal(a.joint_frame[j], eye) for j in free):
        raise unknown("a free joint that does not move along the world's axes")


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


def _plain(frames: Tensor) -> list[int]:
    """Which nodes' frames are turned as their parents'."""
    eye = torch.eye(frames.shape[-1], dtype=frames.dtype)
    return [int(torch.equal(frame, eye)) for frame in frames]


def _above(a: Articulation) -> list[int]:
    """How many dofs each dof rides on, and which, its own joint's first: `nv` numbers of each."""
    t = a.topology
    rows: list[list[int]] = []
    for first, (_, size), parent in zip(t.v_start, t.joint_sizes, t.joint_parent, strict=True):
        last = t.v_start[parent - 1] + t.joint_sizes[parent - 1][1] - 1
        carriers = [last, *rows[last]] if parent else []
        rows += [[*range(first, first + i), *carriers] for i in range(size)]
    return [len(row) for row in rows] + [i for row in rows for i in row + [0] * (t.nv - len(row))]


def _nodes(a: Articulation) -> Sequence[Tensor]:
    """Frames, origins, references and senses of the joints, masses, centres and second moments of all links that ride on each, and
    the mass that it moves."""
    t = a.topology
    ridden = torch.zeros(t.njoint, 4, 4, dtype=a.dtype)
    for link, node in enumerate(t.link_node):
        if node > 0:  # what rides on the world does not move
            ridden[node - 1] += a.link_frame[link] @ a.pseudo_inertia[link] @ a.link_frame[link].mT
    mass, first = ridden[:, 3, 3], ridden[:, :3, 3]
    center = torch.where(mass[:, None] > 0, first / torch.where(mass > 0, mass, 1.0)[:, None], 0.0)
    second = ridden[:, :3, :3] - mass[:, None, None] * center[:, :, None] * center[:, None, :]
    carried = mass.clone()
    for j in range(t.njoint - 1, 0, -1):
        if t.joint_parent[j] > 0:
            carried[t.joint_parent[j] - 1] += carried[j]
    sense = torch.ones_like(mass)
    return a.joint_frame[:, :3, :3], a.joint_frame[:, :3, 3], a.joint_ref, sense, mass, center, second, carried


class _Terms:
    """The numbers of a stepper's terms, of those that are there; the others do nothing."""

    def __init__(self, stepper: EagerStepper[Any], a: Articulation) -> None:
        zero = torch.zeros(a.nv, dtype=a.dtype)
        self.share = zero + (0.5 if isinstance(stepper.integrator, EnergyMomentum) else 1.0)
        self.spring = self.damping = self.armature = self.dry = self.limit = zero
        self.rest = a.rest
        self.limit_release, self.limit_per_force, self.dry_speed = 1.0, 0.0, 1e-3
        self.actuators: Actuators | None = None
        self.drives: Actuators | None = None  # what presses on the limits
        self.pushed: list[int] = []  # nodes
        self.pushes: list[tuple[Tensor, Tensor]] = []  # points and forces
        self.candidates = Candidates()
        seen: set[type] = set()
        for term in stepper.terms:
            inner: Any = term
            if isinstance(term, Fitted):
                self.share, inner = term.share, term.term
            kind = type(inner)
            if kind not in TERMS:
                raise unknown(kind.__name__)
            if kind in seen and kind not in (*CONTACTS, Pushes):
                raise unknown(f"two terms {kind.__name__}")
            seen.add(kind)
            self._take(a, inner)
        if any(x.ndim != 1 for x in (self.share, self.spring, self.damping, self.armature, self.dry, self.limit, self.rest)):
            raise unknown("parameters of joints of their own for each world")
        self._require_own_drives()

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
                self.limit, self.limit_release = term.share * term.stiffness, term.release
                if term.drives is not None:
                    self.limit_per_force, self.drives = term.share / HELD**2, term.drives
            case Actuators():
                if term.gear.ndim != 1:
                    raise unknown("actuators of their own for each world")
                self.actuators = term
            case Contact():
                self.candidates.take(a, term)
            case Pushes():
                self._push(a, term)

    def _require_own_drives(self) -> None:
        if self.drives is not None and not _alike(self.drives, self.actuators):
            raise unknown("limits that other actuators press on than the scene's own")

    def _push(self, a: Articulation, term: Pushes) -> None:
        if term.force.ndim != 2 or term.point.ndim != 2:
            raise unknown("pushes of their own for each world")
        links = torch.tensor(a.topology.link_node, device=a.device)
        some = ((links > 0) & (term.force != 0).any(-1)).nonzero().squeeze(-1)  # what rides on the world does not move
        self.pushed += (links[some] - 1).tolist()
        self.pushes.append((on_nodes(a, some, term.point[some]), term.force[some]))


def _alike(one: Actuators, other: Actuators | None) -> bool:
    """Whether two terms press with the same forces."""
    if other is None:
        return False
    names = ("dof", "gear", "gain", "bias", "stiffness", "control_range", "force_range")
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in names)
