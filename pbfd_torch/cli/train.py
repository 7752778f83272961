"""`pbfd train`: a controller by PPO, or by the simulator's gradients."""

from __future__ import annotations

import enum
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from tqdm import tqdm

from pbfd_torch.cli.options import Dtype, use_threads
from pbfd_torch.cli.outputs import check_folder
from pbfd_torch.cli.ranges import (
    COLLECTORS,
    CONTROL_STEP,
    FACTOR,
    FORCE,
    FRAMES,
    FRICTION_FACTOR,
    MINUTES,
    PROCESSES,
    SEED,
    STEP,
    THREADS,
    WORLDS,
)

PUSH_PROBABILITY = 0.02  # per control step


class Method(enum.StrEnum):
    PPO = "ppo"
    SHAC = "shac"


def train(
    env: Annotated[str, typer.Argument(help="hopper, walker, hopper-3d, walker-3d, cart-pole, reacher or push-box.")],
    out: Annotated[Path, typer.Option(help="Folder for checkpoint, curve and picture.")],
    method: Annotated[Method, typer.Option(help="PPO, or a short-horizon actor–critic on the simulator's gradients.")] = Method.PPO,
    frames: Annotated[int, FRAMES.option("Environment steps in all.")] = 2_000_000,
    minutes: Annotated[float | None, MINUTES.option("Of training in all, whichever comes first.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with what the folder holds.")] = False,
    seed: Annotated[int, SEED.option("Of networks, starts and exploration.")] = 0,
    envs: Annotated[int, WORLDS.option("Worlds of each process.")] = 64,
    workers: Annotated[int, PROCESSES.option("PPO: processes that collect.")] = 1,
    ray: Annotated[int, COLLECTORS.option("PPO: Ray collectors instead, on one machine or a cluster (extra 'ray').")] = 0,
    dtype: Annotated[Dtype, typer.Option(help="Of the simulation.")] = Dtype.FLOAT64,
    control_dt: Annotated[float | None, CONTROL_STEP.option("Seconds between actions; default: the task's.")] = None,
    dt: Annotated[float | None, STEP.option("Time step in seconds; default: one per action.")] = None,
    mass: Annotated[tuple[float, float], FACTOR.option("Range of a factor of all masses, drawn by each world.")] = (1.0, 1.0),
    friction: Annotated[tuple[float, float], FRICTION_FACTOR.option("Likewise of μ.")] = (1.0, 1.0),
    gain: Annotated[tuple[float, float], FACTOR.option("Likewise of what actuators give.")] = (1.0, 1.0),
    push: Annotated[float, FORCE.option("Newtons of pushes that begin or end in every fiftieth step or so.")] = 0.0,
    threads: Annotated[int, THREADS.option("PyTorch's threads inside an operation.")] = 1,
) -> None:
    """Trains a controller. Interrupted at any time, it keeps what the last batch left; --resume goes on from there."""
    from pbfd_torch.envs.named import env_class
    from pbfd_torch.envs.randomization import Randomization
    from pbfd_torch.learning.curve import trailing
    from pbfd_torch.learning.training_env import EnvSettings

    check_folder(out)
    use_threads(threads)
    chances = Randomization(mass, friction, gain, push, PUSH_PROBABILITY if push else 0.0, planar=env_class(env).planar)
    where = EnvSettings(env, envs, seed, dtype.value, control_dt, dt, randomization=None if chances.nothing else chances)
    trainer: Any
    if method is Method.PPO:
        from pbfd_torch.learning.ppo import Ppo, PpoTrainer

        trainer = PpoTrainer(Ppo(where, workers=workers, ray=ray), out, resume)
    else:
        from pbfd_torch.learning.shac import Shac, ShacTrainer

        trainer = ShacTrainer(Shac(where), out, resume)
    with tqdm(total=frames, unit="step", initial=trainer.folder.frames, disable=not sys.stderr.isatty(), leave=False) as bar:

        def progress(row: Any) -> None:
            bar.set_postfix_str(f"return {trailing(trainer.folder.rows)[-1]:.0f}")
            bar.update(row.frames - bar.n)

        try:
            rows = trainer.run(frames, float("inf") if minutes is None else minutes, progress)
        except KeyboardInterrupt:
            rows = trainer.folder.rows
    last = rows[-1] if rows else None
    said = (
        "nothing learnt yet"
        if last is None
        else f"mean return of the last 64 episodes {trailing(rows)[-1]:.1f} after {last.frames} steps, {last.seconds / 60:.1f} min"
    )
    print(f"{said}; written to {out}")
