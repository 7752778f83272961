"""Where a policy can be tried: worlds stepped by PBFD, by Newton–Euler, or by MuJoCo, all behind the same few methods."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from pbfd_torch import models
from pbfd_torch.conventional.newton_euler import NewtonEuler
from pbfd_torch.envs import PbfdEnv
from pbfd_torch.errors import InputError
from pbfd_torch.native.engine import Torch

OWN_FILES = {
    "hopper-3d": "hopper3d",
    "walker-3d": "walker3d",
    "cart-pole": "cart_pole",
    "reacher": "reacher",
    "push-box": "push_box",
}
GYMNASIUM_FILES = {"hopper": "hopper.xml", "walker": "walker2d_v5.xml"}
CONVENTIONAL_DT = 0.002  # [s]: at which Newton–Euler is stable on all of them


class TrialWorlds(Protocol):
    """A batch of worlds `[worlds]` in the environment's coordinates."""

    dt: float
    engine: str
    """That makes the steps: native, torch or mujoco."""

    def start(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Puts them there; where they are then."""
        ...

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A control step: q, v after it, and which worlds `[worlds]` have solved it."""
        ...


class PbfdWorlds:
    """As in training."""

    def __init__(self, env: PbfdEnv) -> None:
        self._env, self.dt, self.engine = env, env.dt, env.simulator.engine

    def start(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """See `TrialWorlds`."""
        self._state = self._env.simulator.initial_state(q, v)
        return q, v

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `TrialWorlds`."""
        solved = torch.ones(len(action), dtype=torch.bool, device=action.device)
        simulator = self._env.simulator
        for _ in range(self._env.substeps):
            self._state, solution = simulator.step(self._state, action)
            solved = solved & solution.solved
        v = simulator.integrator.velocity(simulator.articulation, self._state, simulator.step_size)
        return self._state.q, v, solved


class ConventionalWorlds:
    """Linearised velocities and complementarity contact, in steps of `CONVENTIONAL_DT`."""

    def __init__(self, env: PbfdEnv) -> None:
        self._substeps = max(1, round(env.control_dt / CONVENTIONAL_DT))
        self.dt = env.control_dt / self._substeps
        self._stepper, self.engine = NewtonEuler(env.scene, self.dt), Torch.name

    def start(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """See `TrialWorlds`."""
        self._state = self._stepper.initial_state(q, v)
        return q, v

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `TrialWorlds`."""
        solved = torch.ones(len(action), dtype=torch.bool, device=action.device)
        for _ in range(self._substeps):
            self._state, solution = self._stepper.step(self._state, action)
            solved = solved & solution.solved
        return self._state.q, self._state.v, solved


class MujocoWorlds:
    """MuJoCo: Gymnasium's own file and its 2 ms steps of RK4 for hopper and walker, our file and implicitfast for others."""

    def __init__(self, name: str, env: PbfdEnv) -> None:
        import mujoco

        self._mujoco = mujoco
        self._model = mujoco.MjModel.from_xml_path(str(mujoco_file(name)))
        if name in GYMNASIUM_FILES:
            self.dt = float(self._model.opt.timestep)
        else:
            self._model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
            self.dt = self._model.opt.timestep = 0.002
        self._substeps, self.engine = max(1, round(env.control_dt / self.dt)), "mujoco"
        self._like = env.setup.q

    def start(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """See `TrialWorlds`."""
        self._datas = []
        for a, b in zip(q.double().cpu().numpy(), v.double().cpu().numpy(), strict=True):
            data = self._mujoco.MjData(self._model)
            data.qpos[:], data.qvel[:] = a, b
            self._mujoco.mj_forward(self._model, data)
            self._datas.append(data)
        return q, v

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `TrialWorlds`."""
        for data, control in zip(self._datas, action.double().cpu().numpy(), strict=True):
            data.ctrl[:] = control
            self._mujoco.mj_step(self._model, data, self._substeps)
        q, v = (np.stack([getattr(data, name) for data in self._datas]) for name in ("qpos", "qvel"))
        finite = np.isfinite(q).all(-1) & np.isfinite(v).all(-1)
        to: dict[str, Any] = {"dtype": self._like.dtype, "device": self._like.device}
        return torch.as_tensor(q, **to), torch.as_tensor(v, **to), torch.as_tensor(finite, device=self._like.device)


def mujoco_file(name: str) -> Path:
    """The file that MuJoCo runs for an environment."""
    if name in GYMNASIUM_FILES:
        spec = find_spec("gymnasium")
        assert spec is not None
        assert spec.origin is not None
        return Path(spec.origin).parent / "envs" / "mujoco" / "assets" / GYMNASIUM_FILES[name]
    return Path(models.__file__).parent / f"{OWN_FILES[name]}.xml"


def trial_worlds(on: str, name: str, env: PbfdEnv) -> TrialWorlds:
    """pbfd, newton-euler or mujoco; else raises `InputError`."""
    if on == "pbfd":
        return PbfdWorlds(env)
    if on == "newton-euler":
        return ConventionalWorlds(env)
    if on == "mujoco":
        return MujocoWorlds(name, env)
    raise InputError(f"--on is '{on}': must be one of pbfd, newton-euler, mujoco")
