"""MuJoCo on the slope of Fig. 6, with as many contact points and as much friction as ours. Imported when a run is asked for."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pbfd_torch.bench import mujoco_runs
from pbfd_torch.bench.mujoco_runs import Run
from pbfd_torch.bench.mujoco_scenes import mjcf
from pbfd_torch.models import chains


@dataclass(frozen=True)
class Peer:
    """`softest`: time constant of the contacts [s], or 2Δt where that is longer; 0: as stiff as MuJoCo takes them."""

    title: str
    integrator: str
    softest: float = 0.0


DEFAULT_SOFTNESS = 0.02  # [s], MuJoCo's
PEERS = {
    "mujoco-implicitfast": Peer("MuJoCo implicit", "implicitfast"),
    "mujoco-implicitfast-soft": Peer("MuJoCo impl. soft", "implicitfast", DEFAULT_SOFTNESS),
    "mujoco-rk4": Peer("MuJoCo RK4", "RK4"),
}


def run(name: str, q: Tensor, v: Tensor, dt: float, steps: int, points: int, mu: float, repeats: int) -> Run:
    """The chain from q `[nq]`, v `[nv]`, timed `repeats` times; `points` per link, evenly from end to end."""
    import mujoco

    spec = mujoco.MjSpec.from_string(mjcf("chain-slope"))
    for body in spec.bodies[1:]:
        shape = body.geoms[0]
        for k in range(1, points - 1):
            place = [chains.LENGTH * k / (points - 1), 0.0, 0.0]
            body.add_geom(type=shape.type, size=shape.size, pos=place, contype=shape.contype, conaffinity=shape.conaffinity)
    peer, model = PEERS[name], spec.compile()
    model.opt.timestep = dt
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{peer.integrator.upper()}")
    model.geom_solref[:] = (max(2 * dt, peer.softest), 1.0)
    model.geom_friction[:, 0] = mu
    return mujoco_runs.run(model, q, v, steps, repeats=repeats)
