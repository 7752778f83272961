"""What both formats give to joints: the terms a robot needs, and the check that every joint has something to move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import mass_matrix
from pbfd_torch.errors import ModelError
from pbfd_torch.loading.bounds import COORDINATE, FORCE
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings, checked_coefficient
from pbfd_torch.terms.load import Term
from pbfd_torch.tree.articulation import Articulation, Link

_SMALLEST = 1e-14  # inertia of a joint, relative to the robot's largest, that is a rounding error of zero

_DEPENDENT = 1e-15  # inertia of a joint against those before it, relative to its own, that is a rounding error of zero


@dataclass(frozen=True)
class JointProperties:
    """Numbers of one joint, the same for all its degrees of freedom. SI units of torque or force per coordinate."""

    armature: float = 0.0
    damping: float = 0.0
    stiffness: float = 0.0
    dry_friction: float = 0.0
    spring_rest: Sequence[float] = field(default_factory=tuple)  # coordinates; empty: the reference configuration

    def check(self, joint: str) -> None:
        """Raises `ModelError` naming the joint for a number that is negative, too large or not finite."""
        for what in ("armature", "damping", "stiffness", "dry_friction"):
            value = getattr(self, what)
            if not 0 <= value <= FORCE:
                words = f"{what.replace('_', ' ')} is {value}: must be ≥ 0 and at most {FORCE:g}"
                raise ModelError(words, element=f"joint '{joint}'")
        if not all(abs(x) <= COORDINATE for x in self.spring_rest):
            words = f"springs rest at {tuple(self.spring_rest)}: must be within {COORDINATE:g}"
            raise ModelError(words, element=f"joint '{joint}'")


def articulate(
    links: Sequence[Link], properties: dict[str, JointProperties], dtype: torch.dtype, device: torch.device | str
) -> tuple[Articulation, tuple[Term, ...]]:
    """The articulation and its joint terms, checked in 64 bits before they are rounded to `dtype`."""
    exact = Articulation.from_links(links)
    require_inertia(exact, joint_terms(exact, properties))
    articulation = exact.to(dtype, device)
    return articulation, joint_terms(articulation, properties)


def joint_terms(articulation: Articulation, properties: dict[str, JointProperties]) -> tuple[Term, ...]:
    """Armature, damping, springs and dry friction, each only if some joint has it."""
    t = articulation.topology
    each = [properties.get(name, JointProperties()) for name in t.joint_names]
    for name, joint in zip(t.joint_names, each, strict=True):
        joint.check(name)

    def spread(what: str) -> Tensor:
        values = [getattr(each[j], what) for j in t.dof_joints]
        return checked_coefficient(articulation, torch.tensor(values, dtype=articulation.dtype), what)

    armature, damping, stiffness, friction = (spread(x) for x in ("armature", "damping", "stiffness", "dry_friction"))
    terms: list[Term] = []
    if armature.any():
        terms.append(Armature(armature))
    if damping.any():
        terms.append(JointDamping(damping))
    if stiffness.any():
        rest = articulation.rest.clone()
        for joint, start in zip(each, t.q_start, strict=True):
            rest[start : start + len(joint.spring_rest)] = rest.new_tensor(joint.spring_rest)
        terms.append(JointSprings(stiffness, rest))
    if friction.any():
        terms.append(JointDryFriction(friction))
    return tuple(terms)


def joint_limits(articulation: Articulation, actuators: Actuators | None, gravity: float) -> tuple[JointLimits, ...]:
    """The limits, if some joint has one, as firm as its actuators need them. `gravity`: its size [m/s²]."""
    if not bool(torch.isfinite(torch.cat((articulation.lower, articulation.upper))).any()):
        return ()
    return (JointLimits.for_articulation(articulation, gravity, actuators=actuators),)


def require_inertia(articulation: Articulation, terms: Sequence[Term] = ()) -> None:
    """Raises `ModelError` naming the first joint that can move without moving any mass (at the reference configuration, armatures
    among `terms` included), by itself or against those before it: its acceleration would not be determined."""
    t = articulation.topology
    with torch.no_grad():
        inertia = mass_matrix(articulation, articulation.rest, terms)
    own = inertia.diagonal()
    resting = (own <= _SMALLEST * own.max()).tolist()
    if any(resting):
        j = t.dof_joints[resting.index(True)]
        link, joint = t.link_names[t.joint_link[j]], t.joint_names[j]
        carried = articulation.mass[..., t.subtree[j]].sum()
        what = "have no mass" if carried == 0 else "have all their mass on the axis and no inertia about it"
        raise ModelError(f"link '{link}' and everything it carries {what}: joint '{joint}' has no inertia")
    size = own.rsqrt()
    apart = size[:, None] * inertia * size - _DEPENDENT * torch.eye(articulation.nv, dtype=articulation.dtype)
    dependent = int(torch.linalg.cholesky_ex(apart).info)
    if dependent:
        j = t.dof_joints[dependent - 1]
        raise ModelError(
            f"joint '{t.joint_names[j]}' can move against those before it so that no mass moves: link "
            f"'{t.link_names[t.joint_link[j]]}', or what it carries, needs inertia of its own"
        )
