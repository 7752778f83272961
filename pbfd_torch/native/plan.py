"""A scene as the C++ core sees it: index tables and numbers, in the order in which src/plan.h reads them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.integrators.bdf2 import Bdf2
from pbfd_torch.integrators.fitted import felt_inertia
from pbfd_torch.native.aligned import aligned
from pbfd_torch.native.carriers import Carriers
from pbfd_torch.native.four_poses import Seats
from pbfd_torch.native.not_compiled import unknown
from pbfd_torch.native.plan_bodies import Bodies
from pbfd_torch.native.plan_contact import Candidates, joined, on_nodes
from pbfd_torch.native.plan_torsion import torsions
from pbfd_torch.native.plane import Plane as MotionPlane
from pbfd_torch.native.plane import plane_of
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.tensors.plain import carries
from pbfd_torch.tensors.structures import tensors_of
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.curved_body_contact import CurvedBodyContact
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import HELD, JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.terms.torsional_friction import TorsionalFriction
from pbfd_torch.tree.articulation import Articulation, JointKind, force_scale, reach

KINDS = {(1, 1): 0, JointKind.BALL.value[:2]: 2, JointKind.FREE.value[:2]: 3}  # slides are 1, as src/plan.h has them
CONTACTS = (Contact, CurvedContact, BodyContact, CurvedBodyContact)
SEVERAL = (*CONTACTS, TorsionalFriction, Pushes)  # of which a scene may have more than one
TERMS = (Inertia, JointSprings, JointDamping, Armature, JointDryFriction, JointLimits, Actuators, *SEVERAL)


@dataclass(frozen=True, eq=False)
class Plan:
    """sizes: nodes, nq, nv, nu, those of the candidates, pushes. whole: `[n]` `int32`. real: `[n]` of the scene's dtype;
    `which` of them, `[varied]` `int32`, each world has its `own`, `[*batch, varied]`. sample: `[n]` of terrain and meshes.
    bodies: what may touch between them. dimension: 2 where all moves in a plane. apart: whether worlds differ by more than their
    μ: the core knows these in space only. carriers: of the obstacles that move. order: where the candidates are
    among those of all contact terms. memory: of each term that remembers, in the order of a state's memory, where it begins among
    all numbers that are remembered, and its shape; remembered: how many these are. seats: where links are on the nodes."""

    sizes: tuple[int, ...]
    whole: Tensor
    real: Tensor
    which: Tensor
    own: Tensor
    sample: Tensor
    bodies: Bodies
    dimension: int
    apart: bool
    carriers: Carriers
    order: tuple[int, ...]
    memory: tuple[tuple[int, int, int], ...]
    remembered: int
    seats: Seats

    def take(self, worlds: Worlds) -> Plan:
        """The plan of some worlds, to the bit."""
        return replaced(self, own=worlds.pick(self.own, 1), seats=self.seats.take(worlds), carriers=self.carriers.take(worlds))


def planned(stepper: EagerStepper[Any]) -> Plan:
    """The plan of a stepper's scene, in a plane where it moves in one. Raises `NotCompiledError` naming what the core does not
    know."""
    _require_covered(stepper)
    parts = _parts(stepper)
    spatial = parts.apart or parts.pushed or parts.bodies.rows or len(parts.carriers) or not parts.candidates.flat
    if spatial or isinstance(stepper.integrator, Bdf2):
        # of which the core knows space only
        return parts.plan()
    plane = plane_of(parts.a, [parts.gravity, *parts.candidates.normals])
    return (parts if plane is None else parts.within(plane)).plan()


def planned_in_space(stepper: EagerStepper[Any]) -> Plan:
    """The plan of a scene that the core knows, in space."""
    return _parts(stepper).plan()


def planned_with_derivatives(stepper: EagerStepper[Any]) -> Plan | None:
    """The plan of a scene that the core knows, in space, whose `real` and `own` are functions of all in the stepper that carries
    derivatives; None: something does that has no place among them, or of which the core has none."""
    with torch.enable_grad():
        parts = _parts(stepper)
        plan = parts.plan()
    hidden = [plan.sample, *parts.candidates.laws.constants, *tensors_of(plan.carriers.each)]
    if _free(parts.a):  # they move along the world's axes, whatever their frames
        hidden.append(stepper.articulation.joint_frame)
    return None if any(map(carries, hidden)) else plan


@dataclass(frozen=True, eq=False)
class _Parts:
    """What a plan is made of: nodes, gravity and candidates, of which a plane has its own, and what is the same in it. Numbers are
    `[n]`, or `[*batch, n]` where worlds differ.

    Attributes:
        a: as `aligned` gives it. nodes: see `_nodes`. driven: coordinates and dofs of the actuators. pushed: nodes.
        joints, scene, pushes: numbers, as src/plan.h has them.
    """

    a: Articulation
    nodes: Sequence[Tensor]
    gravity: Tensor
    candidates: Candidates
    bodies: Bodies
    carriers: Carriers
    driven: list[int]
    pushed: list[int]
    joints: Sequence[Tensor]
    scene: Sequence[Tensor]
    pushes: Sequence[Tensor]
    memory: tuple[tuple[int, int, int], ...]
    dimension: int = 3

    @property
    def real(self) -> list[Tensor]:
        """All numbers."""
        nodes = (x.flatten(-rank) for x, rank in zip(self.nodes, (3, 2, 1, 1, 1, 2, 3, 1), strict=True))
        laws = [*self.bodies.laws, *self.candidates.laws.real(), *self.carriers.belts]
        return [*nodes, *self.joints, self.gravity, *self.scene, *self.candidates.real(), *self.pushes, *laws]

    @property
    def apart(self) -> bool:
        """See `Plan`."""
        grips = {id(x) for x in self.candidates.grips}
        return any(x.ndim > 1 and id(x) not in grips for x in self.real)

    def within(self, plane: MotionPlane) -> _Parts:
        """The same in a plane."""
        nodes, candidates = plane.nodes(self.a, self.nodes), self.candidates.within(plane)
        return replaced(self, nodes=nodes, candidates=candidates, gravity=self.gravity @ plane.basis, dimension=2)

    def plan(self) -> Plan:
        """All of it."""
        a, t, candidates = self.a, self.a.topology, self.candidates
        sizes = zip(t.joint_sizes, t.joint_is_hinge, strict=True)
        kinds = [int(not hinge) if size == (1, 1) else KINDS[size] for size, hinge in sizes]
        whole = [parent - 1 for parent in t.joint_parent] + kinds + [*t.q_start, *t.v_start]
        whole += _plain(self.nodes[0]) + _above(a) + self.driven + candidates.whole() + self.pushed + candidates.laws.manners
        whole += candidates.carried if len(self.carriers) else []
        real, which, own = _told_apart(self.real)
        return Plan(
            sizes=(t.njoint, t.nq, t.nv, len(self.driven) // 2, *candidates.sizes, len(self.pushed)),
            whole=torch.tensor(whole, dtype=torch.int32),
            real=real,
            which=which,
            own=own,
            sample=torch.cat([a.rest.new_empty(0), *candidates.samples]),
            bodies=self.bodies,
            carriers=self.carriers,
            dimension=self.dimension,
            apart=self.apart,
            order=candidates.order,
            memory=self.memory,
            remembered=3 * sum(candidates.anchors) + self.bodies.remembered,
            seats=Seats.of(a),
        )


def _parts(stepper: EagerStepper[Any]) -> _Parts:
    """Those of a stepper's scene, in space. Raises `NotCompiledError`."""
    a = aligned(stepper.articulation)
    t, known = a.topology, _Terms(stepper, a)
    felt = felt_inertia(stepper.articulation, stepper.scene.terms)
    # what tells how exact a step must be: no motion depends on it
    measures = [x.detach() for x in (_each(stepper.scale, t.nv), _each(force_scale(a, 1.0), t.nv), reach(a)[..., None])]
    joints = [*measures[:2], t.turns.to(a.dtype), felt]
    joints += [known.spring, known.damping, known.armature, known.dry, a.lower, a.upper, known.limit, known.rest]
    driven: list[int] = []
    if (act := known.actuators) is not None:
        driven = act.coordinate.tolist() + act.dof.tolist()
        joints += [act.gear, act.gain, act.bias, act.stiffness, act.damping]
        joints += [*act.control_range.unbind(-1), *act.force_range.unbind(-1)]
    return _Parts(
        a=a,
        nodes=_nodes(a),
        gravity=stepper.scene.gravity,
        candidates=known.candidates,
        bodies=(bodies := Bodies.of(a, known.meetings, known.carriers, known.candidates.laws, 3 * sum(known.candidates.anchors))),
        carriers=known.carriers,
        driven=driven,
        pushed=known.pushed,
        joints=joints,
        scene=[measures[2], a.rest.new_tensor([known.limit_release, known.limit_per_force, known.dry_speed])],
        pushes=[x[k].flatten(-2) for k in range(2) for x in known.pushes],
        memory=_memory(stepper.scene.terms, known.candidates.anchors, bodies),
    )


def _memory(terms: Sequence[Any], anchors: Sequence[int], bodies: Bodies) -> tuple[tuple[int, int, int], ...]:
    """See `Plan`."""
    found, contacts, meetings = [], iter(anchors), iter(zip(bodies.memory, bodies.kept, strict=True))
    taken = 0
    for term in terms:
        if isinstance(term, BodyContact):
            first, count = next(meetings)
            found.append((max(first, 0), count if first >= 0 else 0, 7))
        elif isinstance(term, Contact):
            count = next(contacts)
            found.append((taken, count, 3))
            taken += 3 * count
    return tuple(found)


def _told_apart(pieces: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Numbers `[n]` that all worlds have, or `[*batch, n]` in pieces, one after the other: of all or of one world, which of them
    the worlds have of their own, and these."""
    ends = list(itertools.accumulate(x.shape[-1] for x in pieces))
    some = [(x, range(end - x.shape[-1], end)) for x, end in zip(pieces, ends, strict=True) if x.ndim > 1]
    own = joined(pieces[0].new_empty(0), *(x for x, _ in some))
    first = [x if x.ndim == 1 else x.flatten(0, -2)[0] for x in pieces]
    return torch.cat(first), torch.tensor([i for _, places in some for i in places], dtype=torch.int32), own


def _each(values: Tensor, count: int) -> Tensor:
    """One number for each of so many, given for all of them or for each, `[*, count]`."""
    return values.expand(*values.shape[:-1], count)


def _require_covered(stepper: EagerStepper[Any]) -> None:
    """Raises `NotCompiledError` for what is not the terms' affair."""
    a = stepper.articulation
    if a.device.type != "cpu":
        raise unknown(f"device {a.device.type}")
    if not isinstance(stepper.evaluations, int):
        raise unknown("evaluations of its own for each world")
    if not bool((a.joint_frame[..., _free(a), :, :] == torch.eye(4, dtype=a.dtype)).all()):
        raise unknown("a free joint that does not move along the world's axes")


def _free(a: Articulation) -> list[int]:
    """The free joints."""
    return [j for j, size in enumerate(a.topology.joint_sizes) if size == (7, 6)]


def _plain(frames: Tensor) -> list[int]:
    """Which nodes' frames are turned as their parents', in all worlds."""
    same = (frames == torch.eye(frames.shape[-1], dtype=frames.dtype)).flatten(-2).all(-1)
    return same.reshape(-1, same.shape[-1]).all(0).int().tolist()


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
    each = a.link_frame @ a.pseudo_inertia @ a.link_frame.mT
    ridden = each.new_zeros(*each.shape[:-3], t.njoint, 4, 4)
    for link, node in enumerate(t.link_node):
        if node > 0:  # what rides on the world does not move
            ridden[..., node - 1, :, :] += each[..., link, :, :]
    mass, first = ridden[..., 3, 3], ridden[..., :3, 3]
    center = torch.where(mass[..., None] > 0, first / torch.where(mass > 0, mass, 1.0)[..., None], 0.0)
    second = ridden[..., :3, :3] - mass[..., None, None] * center[..., :, None] * center[..., None, :]
    carried = mass.clone()
    for j in range(t.njoint - 1, 0, -1):
        if t.joint_parent[j] > 0:
            carried[..., t.joint_parent[j] - 1] += carried[..., j]
    sense = mass.new_ones(t.njoint)
    return a.joint_frame[..., :3, :3], a.joint_frame[..., :3, 3], a.joint_ref, sense, mass, center, second, carried


class _Terms:
    """The numbers of a stepper's terms, of those that are there; the others do nothing."""

    def __init__(self, stepper: EagerStepper[Any], a: Articulation) -> None:
        zero = torch.zeros(a.nv, dtype=a.dtype)
        self.spring = self.damping = self.armature = self.dry = self.limit = zero
        self.rest = a.rest
        self.limit_release, self.limit_per_force, self.dry_speed = 0.1, 0.0, 1e-3
        self.actuators: Actuators | None = None
        self.drives: Actuators | None = None  # what presses on the limits
        self.pushed: list[int] = []  # nodes
        self.pushes: list[tuple[Tensor, Tensor]] = []  # points and forces
        self.carriers = Carriers()
        self.candidates = Candidates(self.carriers)
        self.torsions = torsions(stepper.scene.terms)
        self.meetings: list[BodyContact] = []
        seen: set[type] = set()
        for term in stepper.scene.terms:  # the core fits them itself
            kind = type(term)
            if kind not in TERMS:
                raise unknown(kind.__name__)
            if kind in seen and kind not in SEVERAL:
                raise unknown(f"two terms {kind.__name__}")
            seen.add(kind)
            self._take(a, term)
        self._require_own_drives()

    def _take(self, a: Articulation, term: Any) -> None:
        match term:
            case JointSprings():
                self.spring, self.rest = term.stiffness, term.rest
            case JointDamping():
                self.damping = term.damping
            case Armature():
                self.armature = term.inertia
            case JointDryFriction():
                self.dry, self.dry_speed = term.torque, term.slip_speed
            case JointLimits():
                self.limit, self.limit_release = term.share * term.stiffness, term.release
                if term.drives is not None:
                    self.limit_per_force, self.drives = term.share / HELD**2, term.drives
            case Actuators():
                self.actuators = term
            case Contact():
                self.candidates.take(a, term, self.torsions.pop(id(term), None))
            case BodyContact():
                self.meetings.append(term)
                self.candidates.taken += term.finder.slots
            case Pushes():
                self._push(a, term)

    def _require_own_drives(self) -> None:
        if self.drives is not None and not _alike(self.drives, self.actuators):
            raise unknown("limits that other actuators press on than the scene's own")

    def _push(self, a: Articulation, term: Pushes) -> None:
        links = torch.tensor(a.topology.link_node)
        acts = (term.force != 0).any(-1).reshape(-1, len(links)).any(0)  # in some world
        some = ((links > 0) & acts).nonzero().squeeze(-1)  # what rides on the world does not move
        self.pushed += (links[some] - 1).tolist()
        self.pushes.append((on_nodes(a, some, term.point[..., some, :]), term.force[..., some, :]))


def _alike(one: Actuators, other: Actuators | None) -> bool:
    """Whether two terms press with the same forces."""
    if other is None:
        return False
    names = ("dof", "gear", "gain", "bias", "stiffness", "control_range", "force_range")
    return one is other or all(bool((getattr(one, name) == getattr(other, name)).all()) for name in names)
