"""The `pbfd` command: simulate, view, train, evaluate, optimize, info, scenes, demo, bench."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Annotated

import typer

from pbfd_torch.cli.bench_friction import friction
from pbfd_torch.cli.bench_gradients import gradients
from pbfd_torch.cli.bench_hard_cases import hard_cases
from pbfd_torch.cli.bench_precision import precision
from pbfd_torch.cli.bench_slope import slope
from pbfd_torch.cli.bench_soak import soak
from pbfd_torch.cli.bench_solvers import solvers
from pbfd_torch.cli.bench_speed import speed
from pbfd_torch.cli.evaluate import evaluate
from pbfd_torch.cli.optimize import optimize
from pbfd_torch.cli.options import (
    Choices,
    Device,
    Dtype,
    EngineOption,
    Friction,
    Integrator,
    Schedule,
    SolverChoice,
    load_setup,
    use_threads,
)
from pbfd_torch.cli.ranges import ACCURACY, DURATION, PROCESSES, SEED, STEP, THREADS, WORLDS
from pbfd_torch.cli.train import train
from pbfd_torch.cli.view import view
from pbfd_torch.errors import NotModelledWarning, PbfdError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Articulated bodies with frictional contact, stable at large time steps. "
    "Exit status: 0 solved, 1 some step unsolved, 2 bad input.",
)
bench = typer.Typer(no_args_is_help=True, help="Measures what the library does against the paper's claims.")
bench.command()(solvers)
bench.command()(friction)
bench.command()(precision)
bench.command()(gradients)
bench.command()(speed)
bench.command()(hard_cases)
bench.command()(slope)
bench.command()(soak)
app.add_typer(bench, name="bench")
app.command()(optimize)
app.command()(view)
app.command()(train)
app.command()(evaluate)

_SCENE = typer.Argument(help="A named scene, or a URDF or MJCF file. `pbfd scenes` lists the names.", show_default=False)


@app.command()
def simulate(
    scene: Annotated[str, _SCENE],
    worlds: Annotated[int | None, WORLDS.option("Independent worlds in the batch; default: what the scene has.")] = None,
    duration: Annotated[float | None, DURATION.option("Simulated time in seconds; default: the scene's.")] = None,
    dt: Annotated[float | None, STEP.option("Time step in seconds; default: the scene's.")] = None,
    accuracy: Annotated[
        float | None,
        ACCURACY.option("Let every world choose its steps, each of which may be off by so many metres; --dt: the longest one."),
    ] = None,
    integrator: Annotated[Integrator, typer.Option(help="Time integrator.")] = Integrator.ENERGY_MOMENTUM,
    solver: Annotated[
        SolverChoice, typer.Option(help="Solver; direct: without fallbacks; damped, lm, lbfgs: on ½‖r‖², as the paper has them.")
    ] = SolverChoice.JTJ_LM,
    engine: EngineOption = None,
    friction: Annotated[Friction | None, typer.Option(help="Friction law; default: the scene's (Coulomb).")] = None,
    dtype: Annotated[Dtype, typer.Option(help="Floating-point type.")] = Dtype.FLOAT64,
    device: Annotated[Device, typer.Option(help="Where to compute.")] = Device.CPU,
    schedule: Annotated[
        Schedule, typer.Option(help="Asynchronous: a world that is done with a step does not wait for the others.")
    ] = Schedule.LOCK_STEP,
    workers: Annotated[int, PROCESSES.option("Processes that share the worlds, one CPU core each.")] = 1,
    threads: Annotated[
        int, THREADS.option("PyTorch's threads inside an operation; more than one pays for very large batches only.")
    ] = 1,
    seed: Annotated[int | None, SEED.option("Give all worlds but the first small random extra velocities.")] = None,
    fixed_base: Annotated[
        bool | None,
        typer.Option("--fixed-base/--free-base", help="URDF only: is the root welded to the world?", show_default=False),
    ] = None,
    keyframe: Annotated[
        str | None, typer.Option(help="MJCF only: start from this named state of the file, its control held.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the rollout to this .npz file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")] = False,
) -> None:
    """Simulates a scene or a robot file and reports how it went."""
    from pbfd_torch.cli.simulate import run

    use_threads(threads)
    free_base = None if fixed_base is None else not fixed_base
    choices = Choices(integrator, solver, friction, dtype, device, seed, free_base, keyframe, schedule, workers, accuracy, engine)
    raise typer.Exit(run(load_setup(scene, worlds, choices), choices, duration, dt, out, as_json))


@app.command()
def info(
    file: Annotated[str, typer.Argument(help="A URDF or MJCF file, or a named scene.", show_default=False)],
    fixed_base: Annotated[
        bool | None,
        typer.Option("--fixed-base/--free-base", help="URDF only: is the root welded to the world?", show_default=False),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Says what is in a robot file: links, joints, actuators, shapes, and what is not modelled."""
    from pbfd_torch.cli.info import run

    run(file, None if fixed_base is None else not fixed_base, as_json)


@app.command()
def scenes() -> None:
    """Lists the named scenes."""
    from pbfd_torch.models import SCENES

    for name, build in SCENES.items():
        print(f"{name:18s} {' '.join((build.__doc__ or '').split())}")


@app.command()
def demo(out: Annotated[Path, typer.Option(help="Folder for the rollout and the picture.")] = Path("demo")) -> None:
    """Drops a chain onto a slope, 64 worlds at a step of 0.05 s: summary, rollout and picture."""
    from pbfd_torch.cli.demo import run

    raise typer.Exit(run(out))


def _one_line(message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None) -> str:
    return f"pbfd: warning: {message}\n"


def main() -> None:
    """Entry point. Bad input, and what the system refuses, ends with status 2 and one line that names it."""
    warnings.simplefilter("ignore", NotModelledWarning)  # the commands list these lines themselves
    warnings.formatwarning = _one_line
    try:
        app()
    except (PbfdError, OSError, MemoryError) as error:
        print(f"pbfd: {' '.join(str(error).split()) or 'out of memory'}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
