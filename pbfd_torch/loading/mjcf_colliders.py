"""Collision shapes of an MJCF file: colliders on links, obstacles in the world, and which of them never touch."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.height_field import HeightField
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Capsule, Collider, Cylinder, Ellipsoid, Shape, Solid, Sphere
from pbfd_torch.loading.bounds import SHAPES, require_count, require_near, require_shapes, require_size
from pbfd_torch.loading.collisions import Collisions, as_solid
from pbfd_torch.loading.meshes import HullLosses, reduced_hull
from pbfd_torch.loading.mjcf_model import CompiledModel
from pbfd_torch.loading.report import listing, naming, progress

_PAIR_BIT = 32  # MuJoCo's bits of contype and conaffinity end below


def mjcf_collisions(model: CompiledModel) -> Collisions:
    """What can collide. Raises `ModelError` naming the geom."""
    return Collisions() if model.disabled("contact") else _Reader(model).collisions()


def primitive(kind: str, a: float, b: float, c: float) -> Shape | None:
    """A geom of MuJoCo's by its type and size; None for planes, height fields and meshes."""
    match kind:
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
    return None


@dataclass(frozen=True, eq=False)
class _Reader:
    model: CompiledModel

    def collisions(self) -> Collisions:
        model, m = self.model, self.model.data
        losses = HullLosses()
        colliders: list[Collider] = []
        obstacles: dict[int, HalfSpace | Obstacle] = {}
        odd = []
        paired = {g for pair in model.pairs for g in pair}
        for g in progress(range(m.ngeom), "geoms"):
            if not (m.geom_contype[g] or m.geom_conaffinity[g] or g in paired):
                continue
            with naming(str(model.path), f"geom '{model.geom(g)}'"):
                found = self._obstacle(g, losses) if model.standing[m.geom_bodyid[g]] else self._collider(g, losses)
                if isinstance(found, Collider):
                    colliders.append(found)
                elif found is not None:
                    obstacles[g] = found
                else:
                    odd.append(f"{model.geom(g)} ({model.geom_type(g)})")
                require_count("shapes", len(colliders) + len(obstacles), 2 * SHAPES, "simplify what collides")
        require_shapes(colliders, tuple(obstacles.values()))
        lines = losses.lines()
        if odd:
            lines.append(f"geoms that cannot collide: {listing(odd)}")
        return Collisions(tuple(colliders), tuple(obstacles.values()), self._excluded(obstacles), tuple(lines))

    def _excluded(self, obstacles: dict[int, HalfSpace | Obstacle]) -> tuple[tuple[str, str], ...]:
        """Pairs of names: a moving body is called by its own, a standing one by those of its obstacles."""
        model = self.model

        def names(body: int) -> list[str]:
            if not model.standing[body]:
                return [model.body(body)]
            return [x.name for g, x in obstacles.items() if model.data.geom_bodyid[g] == body]

        moving = [(a, b) for a, b in model.excludes if not (model.standing[a] and model.standing[b])]
        return tuple(pair for a, b in moving for pair in itertools.product(names(a), names(b)))

    def _shape(self, g: int, losses: HullLosses) -> Shape | None:
        model, m = self.model, self.model.data
        if model.geom_type(g) != "mesh":
            return primitive(model.geom_type(g), *m.geom_size[g].tolist())
        mesh = int(m.geom_dataid[g])
        first, count = int(m.mesh_vertadr[mesh]), int(m.mesh_vertnum[mesh])
        name = model.mesh(mesh)
        return losses.keep(name, reduced_hull(m.mesh_vert[first : first + count].astype(float), name=name))

    def _height_field(self, g: int) -> HeightField:
        """MuJoCo's rows run along y and its columns along x; heights are shares of the field's own."""
        m = self.model.data
        k = int(m.geom_dataid[g])
        rows, columns, first = int(m.hfield_nrow[k]), int(m.hfield_ncol[k]), int(m.hfield_adr[k])
        x, y, top, _ = m.hfield_size[k].tolist()
        shares = m.hfield_data[first : first + rows * columns].astype(float).reshape(rows, columns)
        return HeightField(top * shares.T, (2 * x / (columns - 1), 2 * y / (rows - 1)))

    def _collider(self, g: int, losses: HullLosses) -> Collider | None:
        model, m = self.model, self.model.data
        shape = self._shape(g, losses)
        if shape is None:
            return None
        require_size(shape, m.geom_pos[g].tolist(), moving=True)
        return Collider(
            name=model.geom(g),
            link=model.body(int(m.geom_bodyid[g])),
            shape=shape,
            position=tuple(m.geom_pos[g].tolist()),
            quaternion=tuple(m.geom_quat[g].tolist()),
            **self._touching(g),
        )

    def _obstacle(self, g: int, losses: HullLosses) -> HalfSpace | Obstacle | None:
        model = self.model
        position, turn = model.placed.geom_xpos[g], model.placed.geom_xmat[g].reshape(3, 3)
        kind, name, touching = model.geom_type(g), self._obstacle_name(g), self._touching(g)
        require_near("position", position.tolist(), "")
        if kind == "plane":
            normal = turn[:, 2]
            return HalfSpace(name=name, normal=tuple(normal.tolist()), offset=float(normal @ position), **touching)
        shape = self._shape(g, losses)
        solid: Solid | None = self._height_field(g) if kind == "hfield" else None if shape is None else as_solid(shape)
        if solid is None:
            return None
        require_size(solid, position.tolist(), moving=False)
        return Obstacle(name, solid, tuple(position.tolist()), model.geom_quaternion(g), **touching)

    def _obstacle_name(self, g: int) -> str:
        """That of the geom, unless a link that moves has it: `Robot.excluded` knows both by their names."""
        model, name = self.model, self.model.geom(g)
        taken = any(model.body(b) == name for b in range(model.data.nbody) if not model.standing[b])
        return f"{name} (geom)" if taken else name

    def _touching(self, g: int) -> dict[str, Any]:
        """What it touches, and how. Each <pair> gives a bit of its own to the group of one geom and the mask of the other."""
        m = self.model.data
        bits = [1 << (_PAIR_BIT + k) for k in range(len(self.model.pairs))]
        return {
            "friction": float(m.geom_friction[g, 0]),
            "group": int(m.geom_contype[g]) | sum(x for x, (a, _) in zip(bits, self.model.pairs, strict=True) if a == g),
            "mask": int(m.geom_conaffinity[g]) | sum(x for x, (_, b) in zip(bits, self.model.pairs, strict=True) if b == g),
            "priority": int(m.geom_priority[g]),
            "frictionless": bool(m.geom_condim[g] == 1),
        }
