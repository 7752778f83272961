"""The named scenes as MJCF, so that MuJoCo runs what we run.

MuJoCo gets a sphere where our chain has a point with a skin of the same radius. Cones are elliptic with impratio 100, and the
contacts' impedance is close to one; how stiff they are is set with the time step (`mujoco_runs.loaded`). Our mesh of a terrain is
a height field there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

import pbfd_torch.models
from pbfd_torch.contact.mesh_distance import Mesh
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, ConvexHull, Shape, Solid, Sphere
from pbfd_torch.errors import InputError
from pbfd_torch.models import SCENES, boxes, chains
from pbfd_torch.tree.articulation import Articulation

_LEVEL = '<geom type="plane" size="500 5 1"/>'
_UNDER = '<geom type="plane" size="500 5 1" conaffinity="1" contype="0"/>'  # what has contype 1 and conaffinity 0 meets it alone
ROBOTS = {"hopper": "hopper.xml", "walker": "walker.xml", "quadruped": "quadruped.xml", "robot-arm": "arm.xml"}
LOOSE = ("stack-10", "arch", "mesh-terrain")  # scenes of free bodies that touch each other
# scene → (slope [rad], μ or None without contact, gravity [m/s²], is it free?)
_CHAINS: dict[str, tuple[float, float | None, float, bool]] = {
    "chain-fixed": (0.0, None, chains.GRAVITY, False),
    "chain-free": (0.0, None, 0.0, True),
    "chain-ground": (0.0, 0.5, chains.GRAVITY, True),
    "chain-slope": (chains.SLOPE, chains.SLOPE_FRICTION, chains.GRAVITY, True),
    "chain-slope-drop": (chains.SLOPE, chains.SLOPE_FRICTION, chains.GRAVITY, True),
}
NAMES = (*_CHAINS, "box-slide", "dzhanibekov", *LOOSE, *ROBOTS)


def mjcf(name: str, world: int = 0) -> str:
    """The scene `name` of `pbfd_torch.models.SCENES` with the parameters and the start configuration of one of its worlds. Raises
    `InputError` for a scene that is not among `NAMES`."""
    if name in ROBOTS:
        return (Path(pbfd_torch.models.__file__).parent / ROBOTS[name]).read_text()
    if name in _CHAINS:
        return _chain(name)
    if name == "box-slide":
        return _box(world)
    if name == "dzhanibekov":
        return _spinning_body()
    if name in LOOSE:
        return _loose_bodies(name)
    raise InputError(f"no MJCF of the scene '{name}': must be one of {', '.join(NAMES)}")


def _chain(name: str) -> str:
    slope, mu, gravity, free = _CHAINS[name]
    across = chains.MASS * (3 * chains.RADIUS**2 + chains.LENGTH**2) / 12
    content = _inertial(chains.MASS, (chains.MASS * chains.RADIUS**2 / 2, across, across), chains.LENGTH / 2)
    if mu is not None:
        content += "".join(_sphere(chains.RADIUS, (x, 0.0, 0.0)) for x in (0.0, chains.LENGTH))
    start = _start(name) if free else 'pos="0 0 0"'
    body = ""
    for k in reversed(range(10)):
        joint = "<freejoint/>" if free and k == 0 else '<joint type="hinge" axis="0 1 0"/>'
        place = start if k == 0 else f'pos="{chains.LENGTH} 0 0"'
        body = f"<body {place}>{joint}{content}{body}</body>"
    return _world(body, (gravity * math.sin(slope), 0.0, -gravity * math.cos(slope)), mu, "" if mu is None else _UNDER)


def _box(world: int) -> str:
    x, y, z = (2 * h for h in boxes.HALF)
    content = _inertial(1.0, ((y * y + z * z) / 12, (x * x + z * z) / 12, (x * x + y * y) / 12))
    corners = [(i, j, k) for i in (-x, x) for j in (-y, y) for k in (-z, z)]
    content += "".join(_sphere(boxes.RADIUS, (i / 2, j / 2, k / 2)) for i, j, k in corners)
    mu = boxes.SLIDING_FRICTION[world % len(boxes.SLIDING_FRICTION)]
    return _world(f"<body {_start('box-slide')}><freejoint/>{content}</body>", (0.0, 0.0, -boxes.GRAVITY), mu, _UNDER)


def _spinning_body() -> str:
    inertial = _of_link(SCENES["dzhanibekov"]().scene.articulation, 0)
    body = f"<body {_start('dzhanibekov')}><freejoint/>{inertial}</body>"
    return _world(body, (0.0, 0.0, 0.0), None)


def _loose_bodies(name: str) -> str:
    scene = SCENES[name]().scene
    found = [_shape(collider.shape, collider.name) for collider in scene.colliders]
    bodies = "".join(
        f"<body {_start(name, k)}><freejoint/>{_of_link(scene.articulation, k)}<geom {geom}/></body>"
        for k, (geom, _) in enumerate(found)
    )
    (obstacle,) = scene.obstacles
    ground, terrain = _terrain(obstacle.shape) if isinstance(obstacle, Obstacle) else (_LEVEL, "")
    return _world(bodies, scene.gravity.tolist(), obstacle.friction, ground, "".join(asset for _, asset in found) + terrain)


def _shape(shape: Shape, name: str) -> tuple[str, str]:
    """Attributes of a geom, and the asset that it needs."""
    if isinstance(shape, Sphere):
        return f'type="sphere" size="{shape.radius}"', ""
    if isinstance(shape, Box):
        return f'type="box" size="{_text(shape.half_extents)}"', ""
    assert isinstance(shape, ConvexHull)
    return f'type="mesh" mesh="{name}"', f'<mesh name="{name}" vertex="{_text(np.ravel(shape.vertices).tolist())}"/>'


def _terrain(shape: Solid) -> tuple[str, str]:
    """A height field of the upper side of a slab, whose vertices come first, in a square grid about the origin, x by x."""
    assert isinstance(shape, Mesh)
    count = math.isqrt(len(shape.vertices) // 2)
    top = shape.vertices[: count * count].reshape(count, count, 3)
    half, heights, low = top[-1, -1, 0], top[..., 2].T, top[..., 2].min()  # MuJoCo has them y by y
    size = (half, half, heights.max() - low, low - shape.vertices[:, 2].min())
    field = f'nrow="{count}" ncol="{count}" size="{_text(map(float, size))}" elevation="{_text(heights.ravel().tolist())}"'
    return f'<geom type="hfield" hfield="terrain" pos="0 0 {low}"/>', f'<hfield name="terrain" {field}/>'


def _start(name: str, body: int = 0) -> str:
    """Where a free body of the scene starts."""
    q = SCENES[name]().q[0, 7 * body : 7 * body + 7].tolist()
    return f'pos="{_text(q[:3])}" quat="{_text(q[3:7])}"'


def _inertial(mass: float, moments: Sequence[float], along: float = 0.0) -> str:
    return f'<inertial pos="{along} 0 0" mass="{mass}" diaginertia="{_text(moments)}"/>'


def _of_link(articulation: Articulation, k: int) -> str:
    """The inertial of a link that has its centre of mass at its origin."""
    second = articulation.pseudo_inertia[k, :3, :3].diagonal()  # ∫ρ x xᵀ
    return _inertial(float(articulation.mass[k]), (second.sum() - second).tolist())


def _sphere(radius: float, place: Sequence[float]) -> str:
    return f'<geom type="sphere" size="{radius}" contype="1" conaffinity="0" pos="{_text(place)}"/>'


def _world(body: str, gravity: Sequence[float], mu: float | None, ground: str = "", assets: str = "") -> str:
    return f"""<mujoco><option cone="elliptic" impratio="100" gravity="{_text(gravity)}"/>
      <default><geom friction="{mu or 0.0} 0 0" solimp=".99 .999 .001"/></default>
      <asset>{assets}</asset><worldbody>{ground}{body}</worldbody></mujoco>"""


def _text(values: Iterable[float]) -> str:
    return " ".join(map(repr, values))
