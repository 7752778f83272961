"""How large a robot may be: what is beyond is refused at once, with words, instead of being computed for hours.

The bounds are generous. At the largest number of pairs the contacts take about 20 s to set up; at the largest number of degrees of
freedom a step takes a few seconds. Beyond the largest shape contacts of light bodies are not found in a minute.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.height_field import HeightField
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.pairing import touch
from pbfd_torch.contact.shapes import Collider, Shape, Solid
from pbfd_torch.errors import ModelError
from pbfd_torch.terms.actuators import Actuator
from pbfd_torch.tree.articulation import Joint, JointKind, Link

LINKS = 1000
DEGREES_OF_FREEDOM = 2000
SHAPES = 1000  # of links, and as many of the world
GROUNDS = 100  # planes and height fields, each of which is asked on its own
PAIRS = 50_000  # of shapes that may touch
SLOW_PAIRS = 5_000  # from which on setting up contacts takes more than a second
GRID_POINTS = 4_000_000  # of a height field
TRIANGLES = 500_000  # of a mesh
FILE_BYTES = 64 * 2**20  # of a file of any kind
SMALLEST = 1e-9  # [m] of a shape
LARGEST = 1e3  # [m] of a shape that a link carries, from its middle
FARTHEST = 1e5  # [m] of a link in its parent's frame, and of obstacles and their sizes
MASSES = (1e-15, 1e13)  # [kg], besides 0
MOMENT = 1e20  # [kg m²]
FORCE = 1e20  # in SI units, of actuators, springs, damping, friction and armature at joints
COORDINATE = 1e5  # [rad, m] of a reference, and of limits towards it


def require_file_size(file: Path) -> None:
    """Raises `ModelError` for a file of more than 64 MiB."""
    size = file.stat().st_size
    if size > FILE_BYTES:
        raise ModelError(f"has {size / 2**20:.0f} MiB: at most {FILE_BYTES // 2**20} are read; make it smaller", file=str(file))


def require_link_count(links: int, degrees: int = 0) -> None:
    """Raises `ModelError` for too many links or degrees of freedom."""
    require_count("links", links, LINKS, "join those that are fixed to each other")
    require_count("degrees of freedom", degrees, DEGREES_OF_FREEDOM, "fix joints or take bodies away")


def require_links(links: Sequence[Link]) -> None:
    """Raises `ModelError` naming the link or joint whose numbers are out of range, or for too many of them."""
    require_link_count(len(links), sum(joint.kind.nv for link in links for joint in link.joints))
    for link in links:
        element = f"link '{link.name}'"
        require_near("position", link.position, element)
        require_near("centre of mass", link.com, element)
        if link.mass > 0 and not MASSES[0] <= link.mass <= MASSES[1]:
            raise ModelError(f"mass is {link.mass:.4g} kg: must be 0 or from {MASSES[0]:g} to {MASSES[1]:g}", element=element)
        moments = [abs(x) for row in link.inertia for x in row]
        if max(moments) > MOMENT:
            raise ModelError(f"moment of inertia is {max(moments):.4g} kg m²: must be at most {MOMENT:g}", element=element)
        for joint in link.joints:
            _require_joint(joint)


def _require_joint(joint: Joint) -> None:
    element = f"joint '{joint.name}'"
    require_near("anchor", joint.anchor, element)
    if abs(joint.ref) > COORDINATE or joint.lower > COORDINATE or joint.upper < -COORDINATE:
        raise ModelError(
            f"reference is {joint.ref:.4g} and limits are {joint.lower:.4g}, {joint.upper:.4g}: the reference must be from "
            f"{-COORDINATE:g} to {COORDINATE:g}, and a place between must be within the limits",
            element=element,
        )
    if joint.kind in (JointKind.HINGE, JointKind.SLIDE) and math.hypot(*joint.axis) > COORDINATE:
        raise ModelError(f"axis is {joint.axis}: must be at most {COORDINATE:g} long", element=element)


def require_actuators(actuators: Sequence[Actuator]) -> None:
    """Raises `ModelError` naming the actuator whose numbers are out of range."""
    for x in actuators:
        for what in ("gear", "gain", "bias", "stiffness", "damping"):
            if not abs(getattr(x, what)) <= FORCE:
                value = getattr(x, what)
                raise ModelError(f"{what} is {value:.4g}: must be from {-FORCE:g} to {FORCE:g}", element=f"actuator '{x.name}'")
        for what, (low, high) in {"control range": x.control_range, "force range": x.force_range}.items():
            if any(math.isfinite(y) and abs(y) > FORCE for y in (low, high)) or low == math.inf or high == -math.inf:
                words = f"{what} is {low:.4g} to {high:.4g}: must be within {FORCE:g}, or endless"
                raise ModelError(words, element=f"actuator '{x.name}'")


def require_shapes(colliders: Sequence[Collider], obstacles: Sequence[HalfSpace | Obstacle]) -> None:
    """Raises `ModelError` for too many shapes or pairs of them that may touch."""
    require_count("shapes on links", len(colliders), SHAPES, "simplify what collides")
    require_count("shapes of the world", len(obstacles), SHAPES, "simplify what collides")
    grounds = [x for x in obstacles if isinstance(x, HalfSpace) or isinstance(x.shape, HeightField)]
    require_count("planes and height fields", len(grounds), GROUNDS, "use fewer")
    require_count("pairs of shapes that may touch", pair_count(colliders, obstacles), PAIRS, "simplify what collides")


def pair_count(colliders: Sequence[Collider], obstacles: Sequence[HalfSpace | Obstacle]) -> int:
    """Pairs that may touch by their groups and masks: of shapes of different links, and of those with obstacles."""
    kinds = {(x.group, x.mask): x for x in (*colliders, *obstacles)}
    moving = Counter((x.group, x.mask) for x in colliders)
    standing = Counter((x.group, x.mask) for x in obstacles)
    count = sum(n * m for a, n in moving.items() for b, m in standing.items() if touch(kinds[a], kinds[b]))
    count += sum(moving[a] * moving[b] for a, b in combinations(moving, 2) if touch(kinds[a], kinds[b]))
    for same in (moving, *_of_links(colliders)):
        count += (1 if same is moving else -1) * sum(n * (n - 1) // 2 for a, n in same.items() if touch(kinds[a], kinds[a]))
    return count


def _of_links(colliders: Sequence[Collider]) -> list[Counter[tuple[int, int]]]:
    found: dict[str, Counter[tuple[int, int]]] = {}
    for x in colliders:
        found.setdefault(x.link, Counter())[x.group, x.mask] += 1
    return list(found.values())


def require_size(shape: Shape | Solid, position: Sequence[float], moving: bool) -> None:
    """Raises `ModelError` for a shape that is too small, too large or too far away. `moving`: a link carries it."""
    most = LARGEST if moving else FARTHEST
    require_near("position", position, "")
    if isinstance(shape, HeightField):
        nx, ny = shape.heights.shape
        require_count("points of a height field", nx * ny, GRID_POINTS, "use fewer")
        size = max(np.abs(shape.heights).max(), *(n * step for n, step in zip((nx, ny), shape.spacing, strict=True)))
    elif isinstance(shape, Shape):
        centers, radii = shape.candidates()
        size = float((np.abs(centers).max(1) + radii).max())
    else:
        return
    lengths = [x for x in _numbers(shape) if x < SMALLEST]
    if lengths or not SMALLEST <= size <= most:
        least = min(lengths, default=size)
        value = size if size > most else least
        raise ModelError(f"{type(shape).__name__} measures {value:.4g} m from its middle: must be from {SMALLEST:g} to {most:g} m")


def _numbers(shape: Shape | Solid) -> list[float]:
    """The lengths that a shape is given by."""
    values = [x for x in vars(shape).values() if isinstance(x, float | tuple)]
    return [float(y) for x in values for y in (x if isinstance(x, tuple) else (x,))]


def require_count(what: str, count: int, most: int, remedy: str) -> None:
    """Raises `ModelError` where there are more than `most`."""
    if count > most:
        raise ModelError(f"has {count} {what}: at most {most} are possible; {remedy}")


def require_near(what: str, place: Sequence[float], element: str) -> None:
    if not all(abs(x) <= FARTHEST for x in place):
        where = ", ".join(f"{x:.4g}" for x in place)
        raise ModelError(f"{what} is {where} m: must be within {FARTHEST:g} m of its frame", element=element)
