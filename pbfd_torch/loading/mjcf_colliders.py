"""Collision shapes of an MJCF file: colliders on links, half-spaces in the world."""

from __future__ import annotations

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Cylinder, Ellipsoid, Shape, Sphere
from pbfd_torch.loading.meshes import HullLosses, reduced_hull
from pbfd_torch.loading.mjcf_model import CompiledModel, label
from pbfd_torch.loading.report import listing, naming

_PAIR_BIT = 32  # MuJoCo's bits of contype and conaffinity end below


def mjcf_shapes(model: CompiledModel) -> tuple[tuple[Collider, ...], tuple[HalfSpace, ...], list[str]]:
    """Colliders, obstacles, and lines on shapes that are left out. Raises `ModelError` naming the geom."""
    m = model.data
    if model.disabled("contact"):
        return (), (), []
    paired = {g for pair in _pairs(model) for g in pair}
    active = [g for g in range(m.ngeom) if m.geom_contype[g] or m.geom_conaffinity[g] or g in paired]
    standing = [g for g in active if model.standing[m.geom_bodyid[g]]]
    planes = [g for g in standing if _kind(model, g) == "plane"]
    losses = HullLosses()
    colliders, odd = [], []
    for g in active:
        if g in standing:
            continue
        with naming(str(model.path), f"geom '{model.geom(g)}'"):
            shape = _shape(model, g, losses)
            if shape is None:
                odd.append(f"{model.geom(g)} ({_kind(model, g)})")
            else:
                colliders.append(_collider(model, g, shape, planes))
    with naming(str(model.path)):
        obstacles = [_half_space(model, g, 1 << (_PAIR_BIT + k) if g in paired else 0) for k, g in enumerate(planes)]
    lines = losses.lines()
    if odd:
        lines.append(f"geoms of links that cannot collide: {listing(odd)}")
    moving = [g for g in active if g not in standing]
    if walls := [model.geom(g) for g in standing if g not in planes and _meets(model, g, moving)]:
        lines.append(f"geoms fixed to the world, other than planes, are no obstacles ({len(walls)}): {listing(walls)}")
    return tuple(colliders), tuple(obstacles), lines


def _meets(model: CompiledModel, g: int, others: list[int]) -> bool:
    """Whether MuJoCo lets a geom touch any of some others."""
    m = model.data
    allowed = (m.geom_contype[g] & m.geom_conaffinity[others]) | (m.geom_contype[others] & m.geom_conaffinity[g])
    return bool(allowed.any()) or any((x == g and y in others) or (y == g and x in others) for x, y in _pairs(model))


def _pairs(model: CompiledModel) -> set[tuple[int, int]]:
    """Geoms that an explicit <pair> lets touch, whatever their bits."""
    return {(int(x), int(y)) for x, y in zip(model.data.pair_geom1, model.data.pair_geom2, strict=True)}


def _kind(model: CompiledModel, g: int) -> str:
    return label("mjtGeom", model.data.geom_type[g])


def _shape(model: CompiledModel, g: int, losses: HullLosses) -> Shape | None:
    m = model.data
    a, b, c = m.geom_size[g].tolist()
    match _kind(model, g):
        case "sphere":
            return Sphere(a)
        case "capsule":
            return Capsule(a, b)
        case "cylinder":
            return Cylinder(a, b)
        case "box":
            return Box((a, b, c))
        case "ellipsoid":
            return Ellipsoid((a, b, c))
        case "mesh":
            mesh = int(m.geom_dataid[g])
            first, count = int(m.mesh_vertadr[mesh]), int(m.mesh_vertnum[mesh])
            name = model.mesh(mesh)
            return losses.keep(name, reduced_hull(m.mesh_vert[first : first + count].astype(float), name=name))
    return None


def _collider(model: CompiledModel, g: int, shape: Shape, planes: list[int]) -> Collider:
    m = model.data
    explicit = sum(1 << (_PAIR_BIT + k) for k, plane in enumerate(planes) if {(g, plane), (plane, g)} & _pairs(model))
    return Collider(
        name=model.geom(g),
        link=model.body(int(m.geom_bodyid[g])),
        shape=shape,
        position=tuple(m.geom_pos[g].tolist()),
        quaternion=tuple(m.geom_quat[g].tolist()),
        friction=float(m.geom_friction[g, 0]),
        group=int(m.geom_contype[g]) | explicit,
        mask=int(m.geom_conaffinity[g]),
        priority=int(m.geom_priority[g]),
        frictionless=bool(m.geom_condim[g] == 1),
    )


def _half_space(model: CompiledModel, g: int, pair_bit: int) -> HalfSpace:
    """`pair_bit`: what colliders that an explicit <pair> lets touch this plane have in their group, or 0."""
    m = model.data
    normal = model.placed.geom_xmat[g].reshape(3, 3)[:, 2]
    return HalfSpace(
        name=model.geom(g),
        normal=tuple(normal.tolist()),
        offset=float(normal @ model.placed.geom_xpos[g]),
        friction=float(m.geom_friction[g, 0]),
        group=int(m.geom_contype[g]),
        mask=int(m.geom_conaffinity[g]) | pair_bit,
        priority=int(m.geom_priority[g]),
        frictionless=bool(m.geom_condim[g] == 1),
    )
