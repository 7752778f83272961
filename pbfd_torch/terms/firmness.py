"""How firm contacts are unless somebody says otherwise: the largest force that a scene can bring to bear makes a small dent.

C⊥ of a pair whose thinner collider is 2w thick is such that on one point of it

- the weight of everything, and what actuators can go on pressing with besides, rests at most 1 mm and 1.5 % of w deep (what may
  stand on a single point, a ball: at most .55 mm, since it falls √3 times as far in at first);
- the weight and what actuators can do for a moment at most 5 mm and 10 % of w.

A joint presses a collider with its largest force, or with its largest torque over the distance to the collider's farthest point
along the links. It can go on with that between links; and against everything, where all joints up to the world are driven: what
stands on its own feet can press only as long as it leaps. Actuators without a largest force cannot be reckoned with.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.contact.polytope import half_thickness
from pbfd_torch.contact.shapes import Ellipsoid, Shape, Sphere
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation

GRAVITY = 9.81  # [m/s²] of the weight, wherever the scene is
SHALLOWEST = 2e-5  # [m]
TOO_DEEP, TOO_THICK = 10.0, 0.25  # times what a contact is meant for; of w
RESTING, DEEPEST, DEEPEST_BALL = 0.015, 1e-3, 5.5e-4  # of w; [m]; [m]
LEAPING, DEEPEST_LEAP = 0.1, 5e-3


@dataclass(frozen=True)
class Side:
    """One collider: half its thickness [m], whether it may stand on a single point, the force [N] that actuators press it with, and
    whether they can go on with that against the world."""

    half: float
    ball: bool
    force: float
    held: bool


@dataclass(frozen=True)
class Meeting:
    """A pair of colliders: half the thickness [m] of the thinner one, whether one may stand on a single point, and the forces [N]
    of actuators that last, or do not."""

    half: float
    ball: bool
    lasting: float
    leaping: float

    @property
    def resting_depth(self) -> float:
        """How deep it may be [m] under what lasts."""
        return min(max(RESTING * self.half, SHALLOWEST), DEEPEST_BALL if self.ball else DEEPEST)

    @property
    def deepest(self) -> float:
        """How deep it may be [m] before that is a hazard."""
        return TOO_DEEP * self.resting_depth

    def stiffness(self, weight: Tensor) -> Tensor:
        """C⊥ [N/m²] `[*batch]` under a weight `[*batch]` [N]."""
        leap = min(max(LEAPING * self.half, SHALLOWEST), DEEPEST_LEAP)
        lasting, leaping = weight + self.lasting, weight + max(self.lasting, self.leaping)
        return torch.maximum(lasting / self.resting_depth**2, leaping / leap**2)


def firmness(meetings: Sequence[Meeting], articulation: Articulation, base: NormalForce) -> Tensor:
    """What the C⊥ of `base` (α = 2) is to be multiplied by for each meeting, `[*batch, n]`."""
    weight = GRAVITY * articulation.mass.detach().sum(-1)
    return torch.stack([x.stiffness(weight) for x in meetings], -1) / base.stiffness


def deepest(half: Sequence[float], articulation: Articulation, law: NormalForce) -> Tensor:
    """How deep candidates of bodies of half the thickness `half` [m] may be under a normal force of somebody's choice before it is
    a hazard, `[*, n]` [m]."""
    weight = GRAVITY * articulation.mass.detach().sum(-1, keepdim=True)
    stiffness = law.stiffness.detach() if isinstance(law.stiffness, Tensor) else law.stiffness
    meant = (weight / stiffness) ** (1 / law.exponent)
    return torch.minimum(TOO_DEEP * meant, TOO_THICK * meant.new_tensor(half))


def side_of(articulation: Articulation, efforts: Sequence[float], link: int, shape: Shape, extent: float) -> Side:
    """The side of a collider whose farthest point is `extent` [m] from the origin of its link. efforts: the largest force [N] or
    torque [N m] at each degree of freedom, 0: it is not driven, infinite: it has no largest."""
    t = articulation.topology
    node, force, held = t.link_node[link], 0.0, True
    distance = extent + _length(articulation.link_frame[..., link, :3, 3])
    while node:
        j = node - 1
        driven = efforts[t.v_start[j] : t.v_start[j] + t.joint_sizes[j][1]]
        held = held and all(x > 0 for x in driven)
        arm = max(distance, 1e-3) if t.joint_is_hinge[j] else 1.0
        force = max(force, *(x / arm for x in driven if math.isfinite(x)), 0.0)
        distance += _length(articulation.joint_frame[..., j, :3, 3])
        node = t.joint_parent[j]
    return Side(half_thickness(shape), isinstance(shape, Sphere | Ellipsoid), force, held)


def _length(shift: Tensor) -> float:
    """Of the longest of vectors `[*, 3]`."""
    return float(torch.linalg.vector_norm(shift.detach(), dim=-1).max())
