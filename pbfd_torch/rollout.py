"""The record of a rollout: states, contacts and how each step was solved; saved as plain arrays."""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.solvers.objective import is_solved

FORMAT = "pbfd_torch rollout 4"


@dataclass(frozen=True, eq=False)
class Rollout:
    """All arrays run over time first: `T` steps give `T + 1` states and `T` solves. SI units, world coordinates.

    Attributes:
        scene_name, dt, link_names, joint_names: what was simulated, and the step [s].
        time: `[T + 1]` [s].
        q: `[T + 1, *batch, nq]`.
        v: `[T + 1, *batch, nv]` average velocity over the step that ends at `time` (Eq. 3); entry 0 is that of the virtual
            step before the start, which differs from the given velocity by half a step's acceleration.
        link_poses: `[T + 1, *batch, nlink, 3, 4]` [R | t].
        center_of_mass: `[T + 1, *batch, 3]`.
        kinetic_energy, potential_energy: `[T + 1, *batch]` [J]; kinetic: of the average velocity, so half a step
            earlier than the potential one, which holds gravity, springs, limits and contacts.
        linear_momentum, angular_momentum: `[T + 1, *batch, 3]`, the latter about the centre of mass.
        status: `[T, *batch]` values of `Status`; iterations, evaluations: int; residual_norm: ‖r/scale‖₂.
        fallbacks: `[T, *batch, 4]` int, how often each of `FALLBACKS` was tried.
        hazards: `[T, *batch]` int, `Hazard` bits: what may be wrong with a step although it was solved.
        substeps: `[T, *batch]` int, steps that each world has made in it; 1 unless worlds choose their steps themselves.
        lanes: `[]` int, evaluations that the schedule spent on all worlds together, idle ones included.
        contact_point: `[T, *batch, npoint, 3]`; contact_depth: `[T, *batch, npoint]` > 0 inside; contact_force:
            `[T, *batch, npoint, 3]` on the body.
    """

    scene_name: str
    dt: float
    link_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    time: Tensor
    q: Tensor
    v: Tensor
    link_poses: Tensor
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
    substeps: Tensor
    lanes: Tensor
    contact_point: Tensor
    contact_depth: Tensor
    contact_force: Tensor

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
        meta = {"format": FORMAT, "scene_name": self.scene_name, "dt": self.dt}
        meta |= {"link_names": list(self.link_names), "joint_names": list(self.joint_names)}
        arrays = {name: getattr(self, name).cpu().numpy() for name in _ARRAYS}
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
        """Reads what `save` wrote; never unpickles. Raises `InputError` for a missing, damaged or foreign file."""
        try:
            with np.load(path, allow_pickle=False) as file:
                meta = json.loads(str(file["meta"]))
                if meta.get("format") != FORMAT:
                    raise InputError(f"'{path}' has format {meta.get('format')!r}: must be {FORMAT!r}")
                fields: dict[str, Any] = {name: torch.from_numpy(file[name]) for name in _ARRAYS}
                fields |= {name: tuple(map(str, meta[name])) for name in ("link_names", "joint_names")}
                return Rollout(scene_name=str(meta["scene_name"]), dt=float(meta["dt"]), **fields)
        except FileNotFoundError as error:
            raise InputError(f"no rollout at '{path}'") from error
        except InputError:
            raise
        except _UNREADABLE as error:
            raise InputError(f"'{path}' is not a readable rollout: {error}") from error


# what numpy and zipfile raise on damaged files, and what a foreign `meta` leads to
_UNREADABLE = (OSError, ValueError, KeyError, AttributeError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)
_ARRAYS = [f.name for f in dataclasses.fields(Rollout) if f.type == "Tensor"]
