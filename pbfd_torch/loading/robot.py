"""What a robot file becomes: an articulation, the effects at its joints, its collision shapes and its named states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Collider
from pbfd_torch.looks.appearance import Visual
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.load import Term
from pbfd_torch.tree.articulation import Articulation


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A named state: q `[nq]`, v `[nv]`, control `[nu]`."""

    q: Tensor
    v: Tensor
    control: Tensor


@dataclass(frozen=True, eq=False)
class Robot:
    """Attributes:
    name: as the file says.
    articulation: links and joints.
    joint_terms: armature, damping, springs, dry friction and limits, each present only if the file asks for it.
    actuators: None where there is none; their order is the order of the control vector.
    colliders: collision shapes on links.
    obstacles: solids of the world that the file itself contains.
    excluded: pairs of names of links and obstacles that do not touch.
    gravity: [m/s²].
    keyframes: named states.
    visuals: gives what links look like, where the file says so.
    not_modelled: what the file asks for and the simulation leaves out, one line each.
    """

    name: str
    articulation: Articulation
    joint_terms: tuple[Term, ...] = ()
    actuators: Actuators | None = None
    colliders: tuple[Collider, ...] = ()
    obstacles: tuple[HalfSpace | Obstacle, ...] = ()
    excluded: tuple[tuple[str, str], ...] = ()
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    keyframes: dict[str, Keyframe] = field(default_factory=dict)
    visuals: Callable[[], Sequence[Visual]] = tuple
    not_modelled: tuple[str, ...] = ()
