"""`pbfd view`: a rollout, a scene or a robot file in the browser, or as a page, a still or a film."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from tqdm import tqdm

from pbfd_torch.cli.options import Choices, Integrator, load_setup, use_threads
from pbfd_torch.cli.outputs import check_file
from pbfd_torch.cli.ranges import DURATION, FRAME, PORT, SEED, SIDE_BY_SIDE, STEP, WORLDS
from pbfd_torch.errors import InputError
from pbfd_torch.records.rollout import Rollout

if TYPE_CHECKING:
    from pbfd_torch.viewer import Inspector, Live


def view(
    what: Annotated[str, typer.Argument(help="A rollout (.npz), a named scene, or a URDF or MJCF file.", show_default=False)],
    ghost: Annotated[Path | None, typer.Option(help="Another rollout (.npz) of the same robot, drawn over it.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Step the scene in real time: push it, steer it, change μ and Δt.")] = False,
    html: Annotated[Path | None, typer.Option(help="Write one page that plays by itself, without network.")] = None,
    png: Annotated[Path | None, typer.Option(help="Write a still.")] = None,
    film: Annotated[Path | None, typer.Option("--mp4", help="Write a film: .mp4 or .gif.")] = None,
    frame: Annotated[int | None, FRAME.option("Step of the still; default: in the middle.")] = None,
    side_by_side: Annotated[int, SIDE_BY_SIDE.option("Worlds beside each other in files.", "--side-by-side")] = 1,
    contacts: Annotated[bool, typer.Option("--contacts", help="Files show contact points and forces.")] = False,
    worlds: Annotated[int | None, WORLDS.option("Of a scene: independent worlds.")] = None,
    duration: Annotated[float | None, DURATION.option("Of a scene: simulated time in seconds.")] = None,
    dt: Annotated[float | None, STEP.option("Of a scene: time step in seconds.")] = None,
    integrator: Annotated[Integrator, typer.Option(help="Of a scene: time integrator.")] = Integrator.ENERGY_MOMENTUM,
    seed: Annotated[int | None, SEED.option("Of a scene: give all worlds but the first small random velocities.")] = None,
    fixed_base: Annotated[
        bool | None,
        typer.Option("--fixed-base/--free-base", help="URDF only: is the root welded to the world?", show_default=False),
    ] = None,
    keyframe: Annotated[str | None, typer.Option(help="MJCF only: start from this named state of the file.")] = None,
    host: Annotated[str, typer.Option(help="Who may connect: 127.0.0.1 is this computer only, 0.0.0.0 everyone.")] = "127.0.0.1",
    port: Annotated[int, PORT.option("Where; the next free one is taken if it is not free.")] = 8080,
    origin: Annotated[
        list[str] | None,
        typer.Option(help="Of web pages elsewhere that may connect, such as https://hub.example.org; may be given several times."),
    ] = None,
) -> None:
    """Shows a rollout, or simulates and shows a scene or a robot file. With --html, --png or --mp4: writes files instead."""
    from pbfd_torch.viewer import Inspector, Live, save_film, save_html, save_png

    for option, path, endings in (("--html", html, (".html",)), ("--png", png, (".png",)), ("--mp4", film, (".mp4", ".gif"))):
        if path is not None:
            check_file(option, path, *endings)
    use_threads(1)
    recorded = Path(what).suffix == ".npz"
    free_base = None if fixed_base is None else not fixed_base
    choices = Choices(integrator=integrator, seed=seed, free_base=free_base, keyframe=keyframe)
    if live:
        if recorded or ghost or html or png or film:
            raise InputError("--live is for a scene or a robot file, without --ghost, --html, --png and --mp4")
        _serve(Live(load_setup(what, 1, choices), dt, integrator.value, host, port, origin or ()))
        return
    if recorded:
        given = {"--worlds": worlds, "--duration": duration, "--dt": dt, "--seed": seed, "--keyframe": keyframe}
        wrong = [name for name, value in given.items() if value is not None]
        if wrong:
            raise InputError(f"{', '.join(wrong)}: only for scenes and robot files, '{what}' is recorded already")
        rollout = Rollout.load(what)
    else:
        from pbfd_torch.cli.simulate import simulated

        rollout = simulated(load_setup(what, worlds, choices), choices, duration, dt).rollout
    other = None if ghost is None else Rollout.load(ghost)
    if html is not None:
        save_html(rollout, html, other, side_by_side, contacts)
        print(f"page written to {html}")
    if png is not None:
        save_png(rollout, png, frame, other, side_by_side, contacts)
        print(f"still written to {png}")
    if film is not None:
        with tqdm(unit="frame", disable=not sys.stderr.isatty(), leave=False) as bar:

            def progress(done: int, whole: int) -> None:
                bar.total = whole
                bar.update(done - bar.n)

            save_film(rollout, film, other, side_by_side, contacts, progress=progress)
        print(f"film written to {film}")
    if html is None and png is None and film is None:
        _serve(Inspector(rollout, other, host, port, origin or ()))


def _serve(shown: Inspector | Live) -> None:
    """Until Ctrl-C."""
    print(f"open {shown.address} in a browser; Ctrl-C ends", flush=True)
    try:
        shown.wait()
    except KeyboardInterrupt:
        print("\nended")
    finally:
        shown.close()
