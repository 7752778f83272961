"""MuJoCo's compiled model behind the few questions that the loader asks."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pbfd_torch.errors import ModelError
from pbfd_torch.loading.mjcf_file import Source, mjcf_sources, require_compilable
from pbfd_torch.loading.report import existing_file
from pbfd_torch.loading.xml_file import require_root
from pbfd_torch.tree.rotations import quaternion_matrix


def label(enum: str, value: int) -> str:
    """Name of a value of one of MuJoCo's enumerations: label("mjtTrn", 0) is «joint»."""
    import mujoco

    return str(getattr(mujoco, enum)(int(value)).name.split("_", 1)[1].lower())


@dataclass(frozen=True, eq=False)
class CompiledModel:
    """`sources`: the files that it was made of. `data`: MuJoCo's MjModel. `keyframe_count`: of those that the file has; the model
    may hold more, empty ones. Elements without a name are called by what they are and their number: «joint3»."""

    path: Path
    sources: Sequence[Source]
    name: str
    data: Any
    keyframe_count: int

    def _named(self, kind: str, index: int, prefix: str) -> str:
        import mujoco

        return mujoco.mj_id2name(self.data, getattr(mujoco.mjtObj, f"mjOBJ_{kind}"), index) or f"{prefix}{index}"

    def body(self, b: int) -> str:
        return self._named("BODY", b, "body")

    def joint(self, j: int) -> str:
        return self._named("JOINT", j, "joint")

    def geom(self, g: int) -> str:
        return self._named("GEOM", g, "geom")

    def actuator(self, a: int) -> str:
        return self._named("ACTUATOR", a, "actuator")

    def keyframe(self, k: int) -> str:
        return self._named("KEY", k, "key")

    def tendon(self, t: int) -> str:
        return self._named("TENDON", t, "tendon")

    def mesh(self, mesh: int) -> str:
        return self._named("MESH", mesh, "mesh")

    def equality(self, e: int) -> str:
        return self._named("EQUALITY", e, "equality")

    def pair(self, p: int) -> str:
        return self._named("PAIR", p, "pair")

    def geom_type(self, g: int) -> str:
        """plane, sphere, box …"""
        return label("mjtGeom", self.data.geom_type[g])

    def joint_type(self, j: int) -> str:
        """HINGE, SLIDE, BALL or FREE."""
        return label("mjtJoint", self.data.jnt_type[j]).upper()

    def is_scalar(self, j: int) -> bool:
        """A hinge or a slide."""
        return self.joint_type(j) in ("HINGE", "SLIDE")

    def disabled(self, *features: str) -> bool:
        """Whether <option><flag> switches all of these off, by themselves or with all constraints."""
        import mujoco

        constraints = {"limit", "contact", "frictionloss", "equality"}
        flags = self.data.opt.disableflags
        everything = bool(flags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        return all(
            bool(flags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}")) or (everything and name in constraints)
            for name in features
        )

    @cached_property
    def standing(self) -> NDArray[np.bool_]:
        """`[nbody]` the bodies fixed to the world, the world among them."""
        fixed: NDArray[np.bool_] = self.data.body_weldid == 0
        return fixed

    @cached_property
    def placed(self) -> Any:
        """MuJoCo's MjData with all poses at the reference configuration."""
        import mujoco

        data = mujoco.MjData(self.data)
        mujoco.mj_kinematics(self.data, data)
        return data

    def geom_quaternion(self, g: int) -> tuple[float, float, float, float]:
        """How a geom is turned in the world at the reference configuration."""
        import mujoco

        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, self.placed.geom_xmat[g])
        w, x, y, z = quaternion.tolist()
        return w, x, y, z

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Geoms that an explicit <pair> lets touch, whatever their bits."""
        return [(int(x), int(y)) for x, y in zip(self.data.pair_geom1, self.data.pair_geom2, strict=True)]

    @cached_property
    def excludes(self) -> list[tuple[int, int]]:
        """Bodies that an <exclude> keeps from touching."""
        return [(int(s) >> 16, int(s) & 0xFFFF) for s in self.data.exclude_signature]

    def inertia(self, b: int) -> tuple[tuple[float, float, float], ...]:
        """Inertia [kg m²] of a body about its centre of mass, in the body's axes."""
        turn = quaternion_matrix(torch.as_tensor(self.data.body_iquat[b].copy())).numpy()
        matrix = turn @ np.diag(self.data.body_inertia[b]) @ turn.T
        return tuple((float(x), float(y), float(z)) for x, y, z in 0.5 * (matrix + matrix.T))


def compile_mjcf(path: Path) -> CompiledModel:
    """Raises `ModelError` for what is too large or not finite, and with MuJoCo's words on what it does not accept. Passes MuJoCo's
    warnings on as Python's."""
    import mujoco

    file = existing_file(path)
    sources = mjcf_sources(file)
    require_root(sources[0].root, "mujoco", file)
    require_compilable(sources)
    try:
        with _warnings_of(file):
            spec = mujoco.MjSpec.from_file(str(file))
            keyframe_count = len(spec.keys)  # compiling adds empty ones
            return CompiledModel(file, sources, spec.modelname, spec.compile(), keyframe_count)
    except ValueError as error:
        words = "; ".join(line.strip().rstrip(":") for line in str(error).splitlines() if line.strip())
        raise ModelError(words, file=str(file)) from None


@contextmanager
def _warnings_of(file: Path) -> Iterator[None]:
    """MuJoCo would write its warnings to stderr and to a log in the working directory."""
    import mujoco

    found: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(found.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
        for text in found:
            warnings.warn(f"{file}: MuJoCo says: {text.strip()}", stacklevel=3)
