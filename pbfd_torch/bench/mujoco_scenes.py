"""The named scenes as MJCF, so that MuJoCo runs what we run.

MuJoCo gets a sphere where our chain has a point with a skin of the same radius. Cones are elliptic with impratio 100, and the
contacts' impedance is close to one; how stiff they are is set with the time step (`mujoco_runs.loaded`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import pbfd_torch.models
from pbfd_torch.errors import InputError
from pbfd_torch.models import SCENES, boxes, chains

ROBOTS = ("hopper", "walker", "quadruped")
# scene → (slope [rad], μ or None without contact, gravity [m/s²], is it free?)
_CHAINS: dict[str, tuple[float, float | None, float, bool]] = {
    "chain-fixed": (0.0, None, chains.GRAVITY, False),
    "chain-free": (0.0, None, 0.0, True),
    "chain-ground": (0.0, 0.5, chains.GRAVITY, True),
    "chain-slope": (chains.SLOPE, chains.SLOPE_FRICTION, chains.GRAVITY, True),
    "chain-slope-drop": (chains.SLOPE, chains.SLOPE_FRICTION, chains.GRAVITY, True),
}
NAMES = (*_CHAINS, "box-slide", "dzhanibekov", *ROBOTS)


def mjcf(name: str, world: int = 0) -> str:
    """The scene `name` of `pbfd_torch.models.SCENES` with the parameters and the start configuration of one of its worlds. Raises
    `InputError` for a scene that is not among `NAMES`."""
    if name in ROBOTS:
        return (Path(pbfd_torch.models.__file__).parent / f"{name}.xml").read_text()
    if name in _CHAINS:
        return _chain(name)
    if name == "box-slide":
        return _box(world)
    if name == "dzhanibekov":
        return _spinning_body()
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
    return _world(body, (gravity * math.sin(slope), 0.0, -gravity * math.cos(slope)), mu)


def _box(world: int) -> str:
    x, y, z = (2 * h for h in boxes.HALF)
    content = _inertial(1.0, ((y * y + z * z) / 12, (x * x + z * z) / 12, (x * x + y * y) / 12))
    corners = [(i, j, k) for i in (-x, x) for j in (-y, y) for k in (-z, z)]
    content += "".join(_sphere(boxes.RADIUS, (i / 2, j / 2, k / 2)) for i, j, k in corners)
    mu = boxes.SLIDING_FRICTION[world % len(boxes.SLIDING_FRICTION)]
    return _world(f"<body {_start('box-slide')}><freejoint/>{content}</body>", (0.0, 0.0, -boxes.GRAVITY), mu)


def _spinning_body() -> str:
    articulation = SCENES["dzhanibekov"]().scene.articulation
    second = articulation.pseudo_inertia[0, :3, :3].diagonal()  # ∫ρ x xᵀ about the centre of mass, the link's origin
    moments = (second.sum() - second).tolist()
    body = f"<body {_start('dzhanibekov')}><freejoint/>{_inertial(float(articulation.mass[0]), moments)}</body>"
    return _world(body, (0.0, 0.0, 0.0), None)


def _start(name: str) -> str:
    """Where the scene's free body starts."""
    q = SCENES[name]().q[0].tolist()
    return f'pos="{_text(q[:3])}" quat="{_text(q[3:7])}"'


def _inertial(mass: float, moments: Sequence[float], along: float = 0.0) -> str:
    return f'<inertial pos="{along} 0 0" mass="{mass}" diaginertia="{_text(moments)}"/>'


def _sphere(radius: float, place: Sequence[float]) -> str:
    return f'<geom type="sphere" size="{radius}" contype="1" conaffinity="0" pos="{_text(place)}"/>'


def _world(body: str, gravity: Sequence[float], mu: float | None) -> str:
    ground = "" if mu is None else '<geom type="plane" size="500 5 1" conaffinity="1" contype="0"/>'
    return f"""<mujoco><option cone="elliptic" impratio="100" gravity="{_text(gravity)}"/>
      <default><geom friction="{mu or 0.0} 0 0" solimp=".99 .999 .001"/></default>
      <worldbody>{ground}{body}</worldbody></mujoco>"""


def _text(values: Sequence[float]) -> str:
    return " ".join(map(repr, values))
