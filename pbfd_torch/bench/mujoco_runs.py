"""Runs of MuJoCo, one thread: the states at every step, and what they cost. MuJoCo is imported when one is asked for."""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pbfd_torch.bench.mujoco_scenes import ROBOTS, mjcf
from pbfd_torch.bench.timing import Clock, timed

INTEGRATORS = ("Euler", "implicitfast", "discrete", "RK4")
ENGINE = "mujoco"  # beside our own engines' names
_DIVERGED = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC", "mjWARN_INERTIA")


@dataclass(frozen=True, eq=False)
class Run:
    """Attributes:
    q, v: `[steps + 1, nq]`, `[steps + 1, nv]`, the start first; NaN throughout where it diverged.
    diverged: whether MuJoCo found a bad state; it then stops.
    seconds: time of the steps [s], the shortest of a few runs, by the clock that was given.
    """

    q: Tensor
    v: Tensor
    diverged: bool
    seconds: float


def version() -> str | None:
    """MuJoCo's version; None where it cannot be imported."""
    try:
        return str(importlib.import_module("mujoco").__version__)
    except ImportError:
        return None


def absent(so: str) -> tuple[str, ...]:
    """A note that there is no MuJoCo, what follows and what brings it; none where it can be imported."""
    return () if version() else (f"MuJoCo cannot be imported: {so}; pip install 'pbfd_torch[bench]' brings it",)


def loaded(name: str, dt: float, integrator: str, world: int = 0) -> Any:
    """The `MjModel` of a scene with step `dt` [s] and one of the `INTEGRATORS`. Contacts are as stiff as MuJoCo takes them, with a
    time constant of 2Δt and critical damping; those of the robots are as their files have them."""
    model = model_of(mjcf(name, world), dt, integrator)
    if name not in ROBOTS:
        model.geom_solref[:] = (2 * dt, 1.0)
    return model


def model_of(text: str, dt: float, integrator: str) -> Any:
    """The `MjModel` of an MJCF text with step `dt` [s] and one of the `INTEGRATORS`."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep = dt
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    return model


def run(
    model: Any,
    q: Tensor,
    v: Tensor,
    steps: int,
    control: Tensor | None = None,
    repeats: int = 1,
    clock: Clock = time.perf_counter,
) -> Run:
    """Steps from q `[nq]` and v `[nv]`; control: `[steps, nu]`, held over each step, or None for zero. Times up to `repeats` runs,
    all in C."""
    import mujoco
    from mujoco import rollout

    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q.numpy(), v.numpy()
    everything = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros(mujoco.mj_stateSize(model, everything))
    mujoco.mj_getState(model, data, start, everything)
    controls = None if control is None else control.numpy()[None]

    def call() -> Any:
        return rollout.rollout(model, data, start[None], controls, nstep=steps)

    with silent():
        (states, _), seconds = timed(lambda: call, repeats, enough_s=0.3, clock=clock)
    lost = diverged(data)
    path = torch.from_numpy(np.concatenate((start[None], states[0])))  # time, q, v
    path = torch.full_like(path, torch.nan) if lost or not bool(torch.isfinite(path).all()) else path
    return Run(path[:, 1 : 1 + model.nq], path[:, 1 + model.nq : 1 + model.nq + model.nv], bool(path.isnan().any()), seconds)


def diverged(data: Any) -> bool:
    """Whether MuJoCo has found a bad state since its data was made."""
    import mujoco

    return any(data.warning[int(getattr(mujoco.mjtWarning, name))].number > 0 for name in _DIVERGED)


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """MuJoCo would log its warnings into the working directory."""
    import mujoco

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
