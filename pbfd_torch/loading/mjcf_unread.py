"""What an MJCF file says that is not read at all: everything but the elements and attributes listed here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

from pbfd_torch.loading.mjcf_file import Source

_PLACE = "pos quat axisangle xyaxes zaxis euler"
_NAMED = "name class user"

# Read whole: by MuJoCo's compiler, or in `mjcf_features`, which says of each effect whether it is modelled.
_COMPILED = [
    "compiler",
    "frame",
    "replicate",
    "composite",
    "flexcomp",
    "attach",
    "model",
    "mesh",
    "equality",
    "tendon",
    "actuator",
    "flex",
    "extension",
    "plugin",
    "include",
]
# Says nothing about how bodies move: what things look like, where they are seen from, memory, and data of other programs.
_ELSEWHERE = ["visual", "statistic", "light", "camera", "texture", "material", "skin", "size", "custom"]
# Hold other elements, which are looked at in turn; and the attributes that are read of them and of these.
_READ = {
    "mujoco": "model",
    "mujocoinclude": "",
    "worldbody": "name",
    "asset": "",
    "contact": "",
    "keyframe": "",
    "deformable": "",
    "default": "class",
    "option": "gravity density viscosity wind timestep",  # every run is told its own time step
    "flag": "constraint equality frictionloss limit contact spring damper gravity clampctrl filterparent actuation",
    "body": f"{_NAMED} {_PLACE} childclass mocap gravcomp",
    "inertial": f"{_PLACE} mass diaginertia fullinertia",
    "joint": f"{_NAMED} type group pos axis springdamper limited range ref springref stiffness damping armature frictionloss "
    "actuatorfrclimited actuatorfrcrange springyield",
    "freejoint": "name group align",
    "geom": f"{_NAMED} type size fromto {_PLACE} contype conaffinity condim priority friction group mass density shellinertia "
    "mesh hfield fitscale material rgba surfacevel adhesion plugin",
    "hfield": "name content_type file nrow ncol size elevation",
    "pair": f"{_NAMED} geom1 geom2 friction",
    "exclude": "name body1 body2",
    "key": "name qpos qvel ctrl",
}
_ATTRIBUTES = {tag: frozenset(words.split()) for tag, words in _READ.items()}
# Elements of <default> that say what is not looked into above, or that are named where they are used.
_DRIVES = ("general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion", "dcmotor")
_DEFAULTS = (*_DRIVES, "tendon", "site", "mesh", "material", "camera", "light", "equality")


def unread(sources: Iterable[Source]) -> Iterator[str]:
    """One line for each kind of element: those that are not read with what they hold, the others with the attributes that are not;
    and how often each is there."""
    elements: dict[str, Counter[str]] = {}
    attributes: dict[str, Counter[str]] = {}
    pending = [source.root for source in sources]
    while pending:
        node = pending.pop()
        if node.tag in _ATTRIBUTES:
            attributes.setdefault(node.tag, Counter()).update(key for key in node.attrib if key not in _ATTRIBUTES[node.tag])
            pending += [x for x in node if not (node.tag == "default" and x.tag in _DEFAULTS)]
        elif node.tag in ("frame", "replicate"):
            pending += list(node)
        elif node.tag not in (*_COMPILED, *_ELSEWHERE):
            elements.setdefault(node.tag, Counter()).update([x.tag for x in node] or [node.tag])
    for tag, held in sorted(elements.items()):
        own = held.pop(tag, 0)
        yield f"<{tag}>" + (f" ({own})" if own else "") + (f": {_counted(held)}" if held else "")
    for tag, names in sorted(attributes.items()):
        if names:
            yield f"attributes of <{tag}>: {_counted(names)}"


def _counted(names: Counter[Any]) -> str:
    return ", ".join(f"{name} ({count})" for name, count in sorted(names.items()))
