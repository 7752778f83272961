"""The record of a rollout: states, contacts and how each step was solved; saved as plain arrays."""

from __future__ import annotations

import dataclasses
import math
import os
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.checked import Array
from pbfd_torch.errors import InputError
from pbfd_torch.looks.appearance import Appearance, packed, unpacked
from pbfd_torch.records import archive
from pbfd_torch.records.consistency import require_drawable, require_fitting, require_plausible
from pbfd_torch.records.dense_output import DenseOutput, dense_output
from pbfd_torch.solvers.objective import is_solved
from pbfd_torch.tree.articulation import Articulation

FORMAT = "pbfd_torch rollout 6"


@dataclass(frozen=True, eq=False)
class Rollout:
    """All arrays run over time first: `T` steps give `T + 1` states and `T` solves. SI units, world coordinates.

    Attributes:
        scene_name, dt, link_names, joint_names: what was simulated, and the step [s].
        dangers: names of the pairs that can touch and of the limits, for `suspect`.
        appearance: what bodies and obstacles look like.
        time: `[T + 1]` [s].
        q: `[T + 1, *batch, nq]`.
        v: `[T + 1, *batch, nv]` average velocity over the step that ends at `time` (Eq. 3); entry 0 is that of the virtual
            step before the start, which differs from the given velocity by half a step's acceleration.
        link_poses: `[T + 1, *batch, nlink, 3, 4]` [R | t].
        obstacle_poses: `[T + 1, *batch, nobstacle, 3, 4]` likewise, `[1, …]` where all of them stand still; of a plane: how it has
            moved since time 0.
        center_of_mass: `[T + 1, *batch, 3]`.
        kinetic_energy, potential_energy: `[T + 1, *batch]` [J]; kinetic: of the average velocity, so half a step
            earlier than the potential one, which holds gravity, springs, limits and contacts.
        linear_momentum, angular_momentum: `[T + 1, *batch, 3]`, the latter about the centre of mass.
        status: `[T, *batch]` values of `Status`; iterations, evaluations: int; residual_norm: ‖r/scale‖₂.
        fallbacks: `[T, *batch, 4]` int, how often each of `FALLBACKS` was tried.
        hazards: `[T, *batch]` int, `Hazard` bits: what may be wrong with a step although it was solved.
        suspect: `[T, *batch]` int, where a step has a hazard, which of `dangers` is deepest beyond its measure; −1: none.
        substeps: `[T, *batch]` int, steps that each world has made in it; 1 unless worlds choose their steps themselves.
        lanes: `[]` int, evaluations that the schedule spent on all worlds together, idle ones included.
        contact_point: `[T, *batch, npoint, 3]`; contact_depth: `[T, *batch, npoint]` > 0 inside; contact_normal, contact_force (on
            the body) and contact_slip (tangential, over the step): `[T, *batch, npoint, 3]`.
    """

    scene_name: str
    dt: float
    link_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    dangers: tuple[str, ...]
    appearance: Appearance
    time: Tensor
    q: Tensor
    v: Tensor
    link_poses: Tensor
    obstacle_poses: Tensor
    center_of_mass: Tensor
    kinetic_energy: Tensor
    potential_energy: Tensor
    linear_momentum: Tensor
    angular_momentum: Tensor
    status: Tensor
    iterations: Tensor
    evaluations: Tensor
    residual_norm: Tensor
    fallbacks: Tensor
    hazards: Tensor
    suspect: Tensor
    substeps: Tensor
    lanes: Tensor
    contact_point: Tensor
    contact_depth: Tensor
    contact_normal: Tensor
    contact_force: Tensor
    contact_slip: Tensor

    @property
    def steps(self) -> int:
        return len(self.status)

    @property
    def energy(self) -> Tensor:
        """Kinetic plus potential energy [J] `[T + 1, *batch]`."""
        return self.kinetic_energy + self.potential_energy

    @property
    def penetration(self) -> Tensor:
        """Deepest penetration [m] `[T, *batch]`, 0 where nothing touches."""
        if self.contact_depth.shape[-1] == 0:
            return self.contact_depth.new_zeros(self.contact_depth.shape[:-1])
        return self.contact_depth.amax(-1).clamp_min(0)

    def hazardous(self, count: int = 5) -> dict[str, int]:
        """The pairs and limits that most steps with a hazard point to, most of them first, and how many steps of how many worlds
        that are together."""
        found = torch.bincount(self.suspect[self.suspect >= 0].flatten().long(), minlength=len(self.dangers))
        order = found.argsort(descending=True, stable=True)[:count].tolist()
        return {self.dangers[k]: int(found[k]) for k in order if found[k] > 0}

    @property
    def utilisation(self) -> float:
        """Share of the evaluations spent that went to worlds which needed them (Fig. 3)."""
        return float(self.evaluations.sum()) / float(self.lanes)

    @property
    def solved(self) -> Tensor:
        """`[T, *batch]` bool."""
        return is_solved(self.status)

    def at(self, articulation: Articulation, times: Array) -> DenseOutput:
        """The motion at other times `[T]` [s] from the first recorded one to the last: q, v and the poses of the links, in all
        worlds. articulation: the one that has moved, as in `simulator.articulation`. See `dense_output` for how right it is: it
        takes the velocities for those at the recorded times, which those of `ImplicitEuler` and `Variational` are not. Raises
        `InputError` for times outside, and for another articulation."""
        sizes = (articulation.nq, articulation.nv)
        if (self.q.shape[-1], self.v.shape[-1]) != sizes:
            found = (self.q.shape[-1], self.v.shape[-1])
            raise InputError(f"articulation has {sizes} coordinates and velocities: must be those of the rollout, {found}")
        return dense_output(articulation, self.time, self.q, self.v, times)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a compressed .npz with one array per attribute and `meta`, a JSON text. The file appears whole or not at all.
        Raises `InputError` where it cannot be written."""
        words, surfaces = packed(self.appearance)
        meta = {"format": FORMAT, "scene_name": self.scene_name, "dt": self.dt, "appearance": words}
        meta |= {name: list(getattr(self, name)) for name in _NAMES}
        archive.write(path, meta, {name: value.cpu().numpy() for name, value in self._arrays().items()} | surfaces)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Rollout:
        """Reads what `save` wrote; never unpickles. Raises `InputError` for a file that is missing, damaged, foreign or of another
        version, that claims more than half of the memory that is available, whose arrays do not fit each other, or whose poses are
        not finite."""
        try:
            meta, arrays = archive.read(path, FORMAT, (*_ARRAYS, *_SURFACES))
            return _made(meta, arrays)
        except FileNotFoundError as error:
            raise InputError(f"no rollout at '{path}'") from error
        except InputError as error:
            raise InputError(f"'{path}' is not a readable rollout: {error}") from error

    def require_consistent(self) -> None:
        """Raises `InputError` naming the first array whose shape, type or values do not fit the others, with step and world of a
        value. Times, configurations, poses and centres of mass must be finite; everything else in steps that are solved."""
        if not (math.isfinite(self.dt) and self.dt > 0):
            raise InputError(f"dt is {self.dt} s: must be > 0 and finite")
        arrays = self._arrays()
        require_fitting(arrays, len(self.link_names))
        require_plausible(arrays, len(self.dangers))
        require_drawable(self.appearance, self.q.shape[-1])

    def _arrays(self) -> dict[str, Tensor]:
        return {name: getattr(self, name) for name in _ARRAYS}


def _made(meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Rollout:
    """Of a file's contents. Raises `InputError` where they are not those of a rollout."""
    for name, (kind, wanted) in _MEANT.items():
        if not isinstance(meta.get(name), kind) or isinstance(meta[name], bool):
            raise InputError(f"its {name} is {reprlib.repr(meta.get(name))}: must be {wanted}")
    names: dict[str, Any] = {name: tuple(map(str, meta[name])) for name in _NAMES}
    try:
        fields: dict[str, Any] = {name: torch.from_numpy(arrays[name]) for name in _ARRAYS}
        links = len(names["link_names"])
        seen = unpacked(meta["appearance"], arrays, links, links + fields["obstacle_poses"].shape[-3])
    except InputError:
        raise
    except archive.UNREADABLE as error:  # parts of the wrong kind
        raise InputError(f"{type(error).__name__} {error}") from error
    rollout = Rollout(scene_name=meta["scene_name"], dt=float(meta["dt"]), appearance=seen, **names, **fields)
    rollout.require_consistent()
    return rollout


_ARRAYS = [f.name for f in dataclasses.fields(Rollout) if f.type == "Tensor"]
_SURFACES = ("visual_vertices", "visual_faces")
_NAMES = ("link_names", "joint_names", "dangers")
_MEANT: dict[str, tuple[Any, str]] = {
    "scene_name": (str, "a text"),
    "dt": (int | float, "a number"),
    "appearance": (dict, "an object"),
}
_MEANT |= dict.fromkeys(_NAMES, (list, "a list"))
