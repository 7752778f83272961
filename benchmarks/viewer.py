"""What the viewer costs the server: time per frame of 64 worlds side by side, of live mode, and time and memory to open long
rollouts.

    python benchmarks/viewer.py

Prints ms per frame (budget 5 ms: thirty frames a second leave 33), processor time per picture of live mode in every named scene
(budget 20 ms: fifty a second), and seconds and peak memory to load and show 100 000 frames.
"""

from __future__ import annotations

import argparse
import dataclasses
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from pbfd_torch import Rollout, Simulator
from pbfd_torch.models import SCENES
from pbfd_torch.viewer import Inspector, Live
from pbfd_torch.viewer.live import FRAME

FRAMES = 200
LIVE_STEP = 0.005  # [s]
LONG = 100_000


def rolled(worlds: int, steps: int) -> Rollout:
    setup = SCENES["chain-slope-drop"](worlds=worlds)
    simulator = Simulator(setup.scene, 0.05)
    return simulator.rollout(simulator.initial_state(setup.q, setup.v), setup.controls(steps))


def repeated(rollout: Rollout, steps: int) -> Rollout:
    """The rollout over and over."""
    fields = {}
    for field in dataclasses.fields(Rollout):
        value = getattr(rollout, field.name)
        if isinstance(value, torch.Tensor) and value.ndim and len(value) >= rollout.steps:
            wanted = steps + len(value) - rollout.steps
            fields[field.name] = value.repeat(-(-wanted // len(value)), *(1 for _ in value.shape[1:]))[:wanted].clone()
    fields["time"] = rollout.dt * torch.arange(steps + 1, dtype=torch.float64)
    return dataclasses.replace(rollout, **fields)


def frame_cost() -> None:
    inspector = Inspector(rolled(64, 40), port=8900)
    for worlds in (1, 64):
        for contacts in (False, True):
            inspector.stage.contacts.points = inspector.stage.contacts.forces = contacts
            inspector.stage.place(list(range(worlds)))
            started = time.perf_counter()
            for k in range(FRAMES):
                inspector.timeline.go(k % 40)
            cost = 1e3 * (time.perf_counter() - started) / FRAMES
            print(f"{worlds:3d} worlds × 10 links, contacts {'on ' if contacts else 'off'}: {cost:.2f} ms a frame")
    inspector.close()


def live_cost() -> None:
    for name, scene in SCENES.items():
        live = Live(scene(worlds=1), LIVE_STEP, port=8900)
        live._paused = True  # its own clock would step it as well
        live.step(1)
        began, pictures = time.thread_time(), 20
        for _ in range(pictures):
            live.step(round(FRAME / LIVE_STEP))
        print(f"live {name}: {1e3 * (time.thread_time() - began) / pictures:.2f} ms a picture of {FRAME:g} s")
        live.close()


def open_long(path: Path) -> None:
    started = time.perf_counter()
    rollout = Rollout.load(path)
    loaded = time.perf_counter() - started
    inspector = Inspector(rollout, port=8910)
    inspector.timeline.go(LONG // 2)
    shown = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    inspector.close()
    size = path.stat().st_size / 2**20
    print(
        f"{LONG} frames of 10 links, {size:.0f} MiB file: loaded in {loaded:.2f} s, shown after {shown:.2f} s; "
        f"peak memory {peak / 2**20:.2f} GiB"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--open", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.open is not None:
        open_long(given.open)
        return
    frame_cost()
    live_cost()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.npz"
        repeated(rolled(1, 200), LONG).save(path)
        # a process of its own, whose memory is that of opening alone
        subprocess.run([sys.executable, __file__, "--open", str(path)], check=True)


if __name__ == "__main__":
    main()
