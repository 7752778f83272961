"""The record of a rollout: states, contacts and how each step was solved; saved as plain arrays."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import tempfile
import tokenize
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.looks.appearance import Appearance, packed, unpacked
from pbfd_torch.solvers.objective import FALLBACKS, is_solved

FORMAT = "pbfd_torch rollout 6"
LARGEST = 2**35  # [bytes] of all arrays of a file together: what claims more is refused rather than read


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

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a compressed .npz with one array per attribute and `meta`, a JSON text. The file appears whole or not at all.
        Raises `InputError` where it cannot be written."""
        target = Path(path)
        words, surfaces = packed(self.appearance)
        meta = {"format": FORMAT, "scene_name": self.scene_name, "dt": self.dt, "appearance": words}
        meta |= {name: list(getattr(self, name)) for name in _NAMES}
        arrays = {name: getattr(self, name).cpu().numpy() for name in _ARRAYS} | surfaces
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            # written beside the target and renamed: the folder goes with whatever an interruption leaves in it
            with tempfile.TemporaryDirectory(dir=target.parent, prefix=".rollout-") as folder:
                part = Path(folder) / "rollout.npz"
                np.savez_compressed(part, meta=np.array(json.dumps(meta)), **arrays)
                os.replace(part, target)
        except OSError as error:
            raise InputError(f"cannot write '{target}': {error.strerror or error}") from error

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Rollout:
        """Reads what `save` wrote; never unpickles. Raises `InputError` for a file that is missing, damaged, foreign or of another
        version, that claims more than 32 GiB, or whose arrays do not fit each other."""
        try:
            found: Any = np.load(path, allow_pickle=False)
            if isinstance(found, np.ndarray):
                raise InputError(f"'{path}' is not a readable rollout: it is a single array")
            with found as file:
                size = sum(entry.file_size for entry in file.zip.infolist())
                if size > LARGEST:
                    raise InputError(f"'{path}' claims {size / 2**30:.3g} GiB: must be at most {LARGEST / 2**30:.0f}")
                meta = json.loads(str(file["meta"]))
                if meta.get("format") != FORMAT:
                    raise InputError(f"'{path}' has format {meta.get('format')!r}: must be {FORMAT!r}")
                fields: dict[str, Any] = {name: torch.from_numpy(file[name]) for name in _ARRAYS}
                fields |= {name: tuple(map(str, meta[name])) for name in _NAMES}
                surfaces = {name: file[name] for name in ("visual_vertices", "visual_faces")}
            links = len(fields["link_names"])
            seen = unpacked(meta["appearance"], surfaces, links, links + fields["obstacle_poses"].shape[-3])
            rollout = Rollout(scene_name=str(meta["scene_name"]), dt=float(meta["dt"]), appearance=seen, **fields)
            rollout.require_consistent()
        except FileNotFoundError as error:
            raise InputError(f"no rollout at '{path}'") from error
        except InputError as error:
            raise InputError(str(error) if str(path) in str(error) else f"'{path}' is not a readable rollout: {error}") from error
        except _UNREADABLE as error:
            raise InputError(f"'{path}' is not a readable rollout: {type(error).__name__} {error}") from error
        return rollout

    def require_consistent(self) -> None:
        """Raises `InputError` naming the first array whose shape or type does not fit the others."""
        if self.q.ndim < 2 or len(self.q) < 2 or not (math.isfinite(self.dt) and self.dt > 0):
            raise InputError(f"q has shape {tuple(self.q.shape)} and dt is {self.dt} s: must be [T + 1 ≥ 2, *batch, nq], and > 0")
        batch, steps = tuple(self.q.shape[1:-1]), len(self.q) - 1
        slots = self.contact_depth.shape[-1:]
        states: dict[str, tuple[int, ...]] = {
            "v": self.v.shape[-1:],
            "link_poses": (len(self.link_names), 3, 4),
            "center_of_mass": (3,),
        }
        states |= {"linear_momentum": (3,), "angular_momentum": (3,), "kinetic_energy": (), "potential_energy": ()}
        solves: dict[str, tuple[int, ...]] = dict.fromkeys(
            ("status", "iterations", "evaluations", "residual_norm", "hazards", "suspect", "substeps"), ()
        )
        solves |= {"fallbacks": (len(FALLBACKS),), "contact_depth": slots}
        solves |= {f"contact_{what}": (*slots, 3) for what in ("point", "normal", "force", "slip")}
        expected = {name: (steps + 1, *batch, *shape) for name, shape in states.items()}
        expected |= {name: (steps, *batch, *shape) for name, shape in solves.items()}
        moving = len(self.obstacle_poses) if len(self.obstacle_poses) == 1 else steps + 1
        expected |= {"time": (steps + 1,), "lanes": (), "obstacle_poses": (moving, *batch, *self.obstacle_poses.shape[-3:-2], 3, 4)}
        for name, shape in expected.items():
            value: Tensor = getattr(self, name)
            if tuple(value.shape) != tuple(shape):
                raise InputError(f"{name} has shape {tuple(value.shape)}: must be {tuple(shape)}")
            if value.is_floating_point() == (name in _COUNTS):
                raise InputError(f"{name} is {value.dtype}: must be {'integers' if name in _COUNTS else 'floating-point numbers'}")
        if bool(((self.suspect < -1) | (self.suspect >= len(self.dangers))).any()):
            raise InputError(f"suspect holds {self.suspect.unique().tolist()}: must be from -1 to {len(self.dangers) - 1}")


# what numpy and zipfile raise on damaged files, and what a foreign `meta` leads to
_UNREADABLE = (
    OSError, ValueError, LookupError, AttributeError, TypeError, EOFError, RuntimeError, RecursionError, MemoryError,
    zipfile.BadZipFile, zlib.error, SyntaxError, tokenize.TokenError,
)  # fmt: skip
_ARRAYS = [f.name for f in dataclasses.fields(Rollout) if f.type == "Tensor"]
_COUNTS = {"status", "iterations", "evaluations", "fallbacks", "hazards", "suspect", "substeps", "lanes"}
_NAMES = ("link_names", "joint_names", "dangers")
