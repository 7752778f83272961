"""The articulated body: a tree of links and joints as tensors, parents first, validated once.

`Link` and `Joint` are what a file or a user writes down. `Articulation.from_links` turns them into tensors. Inside, the tree
is one of joints ("nodes", node 0 is the world): a link with several joints rides on the last of them, and a link
without joints rides on its parent's node, so fixed links cost no kinematics.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from pbfd_torch.errors import InputError, ModelError
from pbfd_torch.tensors.shapes import broadcast_shapes
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.tree.bounds import HEAVIEST, LIGHTEST, MASSES
from pbfd_torch.tree.rotations import quaternion_matrix
from pbfd_torch.tree.topology import Topology


class JointKind(enum.Enum):
    """Degrees of freedom that a joint leaves between its two sides. A link without joints is fixed to its parent.

    The tuple is (number of coordinates in q, number of tangent coordinates in v).

    * HINGE: angle [rad] about `axis`; SLIDE: displacement [m] along `axis`;
    * BALL: unit quaternion (w, x, y, z); tangent: rotation in the link's own axes;
    * FREE: position of the link's origin, then quaternion; tangent: translation in world axes, then rotation in the link's
      own axes. Only for links whose parent is the world.
    """

    HINGE = (1, 1, "hinge")
    SLIDE = (1, 1, "slide")
    BALL = (4, 3, "ball")
    FREE = (7, 6, "free")

    @property
    def nq(self) -> int:
        return int(self.value[0])

    @property
    def nv(self) -> int:
        return int(self.value[1])


@dataclass(frozen=True)
class Joint:
    """One joint of a link. `axis` and `anchor` [m] in the link's frame; `ref`: the coordinate [rad or m] at which the
    link stands at its reference placement; `lower`, `upper`: limits of the coordinate (hinge and slide)."""

    name: str
    kind: JointKind
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    anchor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ref: float = 0.0
    lower: float = -math.inf
    upper: float = math.inf


@dataclass(frozen=True)
class Link:
    """One rigid link. `parent`: a link's name, or "" for the world. `position` [m] and `quaternion` (w, x, y, z): its frame
    in the parent's frame when every joint stands at its `ref`. `com` [m]: centre of mass in the link's frame; `inertia`
    [kg m²]: 3×3 about the centre of mass, in the link's axes. A link that only connects others has mass 0 and inertia 0."""

    name: str
    parent: str = ""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    joints: tuple[Joint, ...] = ()
    mass: float = 0.0
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),) * 3


def pseudo_inertia(mass: Tensor, com: Tensor, inertia: Tensor) -> Tensor:
    """S = ∫ρ x̄ x̄ᵀ (METHOD Eq. 5) from mass [kg] `[*]`, COM [m] `[*, 3]` and inertia about the COM [kg m²] `[*, 3, 3]`."""
    trace = inertia.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(3, dtype=inertia.dtype, device=inertia.device)
    first = mass[..., None] * com
    second = 0.5 * trace * eye - inertia + first[..., :, None] * com[..., None, :]
    top = torch.cat((second, first[..., None]), -1)
    return torch.cat((top, torch.cat((first, mass[..., None]), -1)[..., None, :]), -2)


def homogeneous(rotation: Tensor, translation: Tensor) -> Tensor:
    """4×4 matrix [R t; 0 1] from `[*, 3, 3]` and `[*, 3]`."""
    top = torch.cat((rotation, translation[..., None]), -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat((top, bottom), -2)


@dataclass(frozen=True, eq=False)
class Articulation:
    """A tree of links as tensors. Numeric fields may carry leading batch dimensions (one value per world) and may
    require gradients; change them with `dataclasses.replace`.

    Attributes:
        topology: the static part (names, kinds, indices).
        joint_frame: `[*, njoint, 4, 4]` each joint's frame on its previous node, at the joint's `ref`.
        joint_axis: `[*, njoint, 3]` unit axis in the joint's frame (unused by ball and free joints).
        joint_ref: `[*, njoint]` coordinate [rad or m] at the reference placement.
        link_frame: `[*, nlink, 4, 4]` each link's frame on its node.
        pseudo_inertia: `[*, nlink, 4, 4]` ∫ρ x̄ x̄ᵀ in the link's frame [kg, kg m, kg m²].
        lower, upper: `[*, nv]` joint limits, ∓inf where there is none.
        rest: `[nq]` the reference configuration.
    """

    topology: Topology
    joint_frame: Tensor
    joint_axis: Tensor
    joint_ref: Tensor
    link_frame: Tensor
    pseudo_inertia: Tensor
    lower: Tensor
    upper: Tensor
    rest: Tensor

    @staticmethod
    def from_links(links: Sequence[Link], dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Articulation:
        """Builds and validates the tree. Raises `ModelError` naming the link or joint and what is wrong with it."""
        return _build(links).to(dtype, torch.device(device))

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Articulation:
        """The same articulation in another floating-point type (float32 or float64) or on another device."""
        if dtype not in (torch.float32, torch.float64):
            raise InputError(f"dtype {dtype}: must be torch.float32 or torch.float64")
        where = self.rest.device if device is None else torch.device(device)
        numeric = {f.name: getattr(self, f.name).to(where, dtype) for f in dataclasses.fields(self) if f.name != "topology"}
        return dataclasses.replace(self, topology=self.topology.to(where), **numeric)

    def take(self, worlds: Worlds) -> Self:
        """The same tree with the values of some worlds."""
        return replaced(self, **{name: worlds.pick(getattr(self, name), len(shape)) for name, shape in self._shapes.items()})

    @property
    def _shapes(self) -> dict[str, tuple[int, ...]]:
        """Of the numeric fields, without their batch dimensions."""
        t = self.topology
        return {
            "joint_frame": (t.njoint, 4, 4),
            "joint_axis": (t.njoint, 3),
            "joint_ref": (t.njoint,),
            "link_frame": (t.nlink, 4, 4),
            "pseudo_inertia": (t.nlink, 4, 4),
            "lower": (t.nv,),
            "upper": (t.nv,),
            "rest": (t.nq,),
        }

    def __post_init__(self) -> None:
        for name, shape in self._shapes.items():
            value: Tensor = getattr(self, name)
            if tuple(value.shape[value.ndim - len(shape) :]) != shape:
                raise InputError(f"{name} has shape {tuple(value.shape)}: must end in {shape}")
            if value.dtype != self.rest.dtype or value.device != self.rest.device:
                raise InputError(f"{name} is {value.dtype} on {value.device}: must be {self.rest.dtype} on {self.rest.device}")
            if bool((torch.isnan(value) if name in ("lower", "upper") else ~torch.isfinite(value)).any()):
                raise InputError(f"{name} holds NaN or infinity: must be finite, but for limits that do not limit")
        self._check_inertia()

    def _check_inertia(self) -> None:
        with torch.no_grad():
            mass = self.mass
            eye = torch.eye(3, dtype=mass.dtype, device=mass.device)
            divisor = torch.where(mass > 0, mass, torch.ones_like(mass))[..., None]
            first = self.pseudo_inertia[..., :3, 3]
            second = self.pseudo_inertia[..., :3, :3] - first[..., :, None] * first[..., None, :] / divisor[..., None]
            inertia = second.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * eye - second
            least = torch.linalg.eigvalsh(0.5 * (inertia + inertia.mT)).amin(-1)
            size = self.pseudo_inertia.abs().amax((-2, -1))
            slack = 1e-9 if self.rest.dtype == torch.float64 else 1e-4
            for k, name in enumerate(self.topology.link_names):
                if not bool((mass[..., k] >= 0).all()):
                    raise ModelError(f"mass is {float(mass[..., k].min())} kg: must be ≥ 0", element=f"link '{name}'")
                if len(odd := mass[..., k][(mass[..., k] > 0) & ((mass[..., k] < LIGHTEST) | (mass[..., k] > HEAVIEST))]):
                    raise ModelError(f"mass is {float(odd[0]):g} kg: must be 0, or {MASSES}", element=f"link '{name}'")
                if not bool((least[..., k] >= -slack * size[..., k]).all()):
                    raise ModelError(
                        f"inertia is not positive semi-definite: smallest principal moment {float(least[..., k].min()):.3g} kg m²",
                        element=f"link '{name}'",
                    )

    @property
    def dtype(self) -> torch.dtype:
        return self.rest.dtype

    @property
    def device(self) -> torch.device:
        return self.rest.device

    @property
    def nq(self) -> int:
        """Number of coordinates in q."""
        return self.topology.nq

    @property
    def nv(self) -> int:
        """Number of degrees of freedom: length of tangent vectors, velocities and residuals."""
        return self.topology.nv

    @property
    def nlink(self) -> int:
        return self.topology.nlink

    @property
    def link_names(self) -> tuple[str, ...]:
        return self.topology.link_names

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self.topology.joint_names

    @property
    def mass(self) -> Tensor:
        """Masses [kg] `[*, nlink]`."""
        return self.pseudo_inertia[..., 3, 3]

    def link_index(self, name: str) -> int:
        """Index of a link by name; raises `InputError` with the valid names."""
        return _index(name, self.link_names, "link")

    def joint_index(self, name: str) -> int:
        """Index of a joint by name; raises `InputError` with the valid names."""
        return _index(name, self.joint_names, "joint")


def force_scale(articulation: Articulation, gravity: float | Tensor) -> Tensor:
    """Size `[*, nv]` of a force that counts as one: the weight [N] for translations, weight × reach [N m] for rotations, with
    gravity [m/s²] (one number or `[*batch]`) taken as at least 1, so that weightless scenes have a scale too."""
    # a number stays one: as a tensor it would have to be copied to the device
    strength = gravity.clamp_min(1.0)[..., None] if isinstance(gravity, Tensor) else max(gravity, 1.0)
    weight = articulation.mass.sum(-1, keepdim=True) * strength
    return (weight * lever(articulation)).detach()


def lever(articulation: Articulation) -> Tensor:
    """What a force at the articulation's reach does to each degree of freedom, `[*, nv]`: the reach [m] for rotations, 1 for
    translations."""
    return torch.where(articulation.topology.turns, reach(articulation)[..., None], 1.0)


def reach(articulation: Articulation) -> Tensor:
    """Length scale of the articulation [m] `[*]`, at least 1 cm: distances from joint to joint summed, plus the largest radius of
    gyration of a link about its own frame."""
    each = articulation.joint_frame[..., :3, 3], articulation.link_frame[..., :3, 3]
    batch = broadcast_shapes(*(x.shape[:-2] for x in each))
    frames = torch.cat([x.expand(*batch, *x.shape[-2:]) for x in each], -2)
    second = articulation.pseudo_inertia[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(0)
    mass = articulation.mass
    gyration = (second / torch.where(mass > 0, mass, torch.ones_like(mass))).sqrt().amax(-1)
    return (torch.linalg.vector_norm(frames, dim=-1).sum(-1) + gyration).clamp_min(1e-2)


def _index(name: str, names: Sequence[str], what: str) -> int:
    if name not in names:
        raise InputError(f"no {what} named '{name}': the {what}s are {', '.join(names)}")
    return list(names).index(name)


def _frame(position: Sequence[float], quaternion: Sequence[float]) -> Tensor:
    return homogeneous(
        quaternion_matrix(torch.tensor(quaternion, dtype=torch.float64)), torch.tensor(position, dtype=torch.float64)
    )


def _check_link(link: Link, known: dict[str, int], joint_names: set[str]) -> None:
    element = f"link '{link.name}'"
    if link.name in known:
        raise ModelError("the name is used twice", element=element)
    if link.parent and link.parent not in known:
        raise ModelError(f"parent '{link.parent}' is not among the links before it", element=element)
    numbers = [*link.position, *link.quaternion, link.mass, *link.com, *(x for row in link.inertia for x in row)]
    if not all(math.isfinite(x) for x in numbers):
        raise ModelError("position, quaternion, mass, com and inertia must be finite", element=element)
    if not any(link.quaternion):
        raise ModelError("quaternion is zero", element=element)
    if link.mass < 0:
        raise ModelError(f"mass is {link.mass} kg: must be ≥ 0", element=element)
    for joint in link.joints:
        name = f"joint '{joint.name}'"
        if joint.name in joint_names:
            raise ModelError("the name is used twice", element=name)
        joint_names.add(joint.name)
        if not all(math.isfinite(x) for x in (*joint.axis, *joint.anchor, joint.ref)):
            raise ModelError("axis, anchor and ref must be finite", element=name)
        if math.isnan(joint.lower) or math.isnan(joint.upper):
            raise ModelError(f"limits are {joint.lower}, {joint.upper}: must be numbers", element=name)
        if joint.kind in (JointKind.HINGE, JointKind.SLIDE) and math.hypot(*joint.axis) < 1e-12:
            raise ModelError(f"axis is {joint.axis}: must not be zero", element=name)
        if joint.lower > joint.upper:
            raise ModelError(f"lower limit {joint.lower} is above upper limit {joint.upper}", element=name)
        if joint.kind is JointKind.FREE and (link.parent or len(link.joints) > 1):
            raise ModelError("a free joint must be the only joint of a link whose parent is the world", element=name)
    principal = torch.linalg.eigvalsh(torch.tensor(link.inertia, dtype=torch.float64))
    if principal[0] + principal[1] < principal[2] * (1 - 1e-6) and principal[0] >= 0:
        warnings.warn(
            f"{element}: principal moments {principal.tolist()} break the triangle inequality: no mass distribution has them",
            stacklevel=4,
        )


def _build(links: Sequence[Link]) -> Articulation:
    if not links:
        raise ModelError("an articulation needs at least one link")
    known: dict[str, int] = {}
    joint_names: set[str] = set()
    link_parent: list[int] = []
    link_node: list[int] = []
    link_frame: list[Tensor] = []
    kinds, joint_link, joint_parent, joint_frame, axes, refs, lower, upper = [], [], [], [], [], [], [], []
    rest: list[float] = []
    for k, link in enumerate(links):
        _check_link(link, known, joint_names)
        known[link.name] = k
        parent = known[link.parent] if link.parent else -1
        node = link_node[parent] if link.parent else 0
        frame = _frame(link.position, link.quaternion)
        frame = link_frame[parent] @ frame if link.parent else frame
        for joint in link.joints:
            anchor = _frame(joint.anchor, (1, 0, 0, 0))
            free = joint.kind is JointKind.FREE
            kinds.append(joint.kind)
            joint_link.append(k)
            joint_parent.append(node)
            joint_frame.append(torch.eye(4, dtype=torch.float64) if free else frame @ anchor)
            axes.append([x / max(math.hypot(*joint.axis), 1e-12) for x in joint.axis])
            refs.append(joint.ref)
            scalar = joint.kind in (JointKind.HINGE, JointKind.SLIDE)
            lower += [joint.lower if scalar else -math.inf] * joint.kind.nv
            upper += [joint.upper if scalar else math.inf] * joint.kind.nv
            norm = math.hypot(*link.quaternion)
            rest += [joint.ref] if scalar else []
            rest += [*link.position, *(x / norm for x in link.quaternion)] if free else []
            rest += [1.0, 0.0, 0.0, 0.0] if joint.kind is JointKind.BALL else []
            node = len(kinds)
            frame = torch.eye(4, dtype=torch.float64) if free else torch.linalg.inv(anchor)
        link_parent.append(parent)
        link_node.append(node)
        link_frame.append(frame)
    if not kinds:
        raise ModelError("no link can move: the articulation needs at least one joint")
    as64 = [
        torch.tensor(x, dtype=torch.float64) for x in ([x.mass for x in links], [x.com for x in links], [x.inertia for x in links])
    ]
    return Articulation(
        topology=Topology(
            link_names=tuple(x.name for x in links),
            link_parent=tuple(link_parent),
            link_node=tuple(link_node),
            joint_names=tuple(j.name for x in links for j in x.joints),
            joint_sizes=tuple((kind.nq, kind.nv) for kind in kinds),
            joint_is_hinge=tuple(kind is JointKind.HINGE for kind in kinds),
            joint_link=tuple(joint_link),
            joint_parent=tuple(joint_parent),
            device=torch.device("cpu"),
        ),
        joint_frame=torch.stack(joint_frame),
        joint_axis=torch.tensor(axes, dtype=torch.float64),
        joint_ref=torch.tensor(refs, dtype=torch.float64),
        link_frame=torch.stack(link_frame),
        pseudo_inertia=pseudo_inertia(*as64),
        lower=torch.tensor(lower, dtype=torch.float64),
        upper=torch.tensor(upper, dtype=torch.float64),
        rest=torch.tensor(rest, dtype=torch.float64),
    )
