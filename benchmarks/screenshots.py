"""The README's pictures of the viewer, taken in a browser without a window.

    python benchmarks/screenshots.py docs

viewer-live.png.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from pbfd_torch import Rollout, Simulator
from pbfd_torch.models import SCENES, Setup
from pbfd_torch.viewer import Inspector, Live
from pbfd_torch.viewer.browser import page

SIZE = (1280, 760)
SETTLING = 4.0  # [s]


def rolled(setup: Setup, dt: float, duration: float, v: torch.Tensor | None = None) -> Rollout:
    simulator = Simulator(setup.scene, dt)
    state = simulator.initial_state(setup.q, setup.v if v is None else v)
    return simulator.rollout(state, setup.controls(round(duration / dt)))


def scattered(name: str, worlds: int) -> tuple[Setup, torch.Tensor]:
    """A named scene whose worlds start with different velocities."""
    setup = SCENES[name](worlds=worlds)
    random = torch.Generator().manual_seed(0)
    return setup, setup.v + 0.5 * torch.randn(setup.v.shape, generator=random, dtype=torch.float64)


def taken(tab: Any, shown: Inspector | Live, path: Path, prepare: Callable[[], object] = lambda: None) -> None:
    tab.goto(shown.address)
    tab.wait_for_selector("text=Draw" if isinstance(shown, Inspector) else "text=Friction")
    # a browser without a graphics card says so in a notice over the scene
    tab.add_style_tag(content=".mantine-Notifications-root { display: none }")
    time.sleep(SETTLING)
    prepare()
    time.sleep(SETTLING)
    tab.screenshot(path=path)
    shown.close()
    print(path)


def clicked(tab: Any, *labels: str) -> None:
    for label in labels:
        tab.get_by_label(label).click()
    tab.mouse.move(10, 300)  # no hint over the panel


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    with page(*SIZE) as tab:
        setup, v = scattered("chain-slope-drop", 4)
        inspector = Inspector(rolled(setup, 0.02, 1.2, 0.4 * v), port=8950)
        inspector.timeline.go(19)
        taken(
            tab, inspector, folder / "viewer-contacts.png", lambda: clicked(tab, "Contact points", "Contact forces", "Joint axes")
        )

        setup, v = scattered("walker", 2)
        inspector = Inspector(rolled(setup, 0.008, 1.2, v), port=8951)
        inspector.stage.contacts.points = inspector.stage.contacts.forces = True
        inspector.timeline.go(85)

        setup = SCENES["chain-fixed"]()
        inspector = Inspector(rolled(setup, 0.002, 1.0), rolled(setup, 0.1, 1.0), port=8952)
        inspector.timeline.go(400)
        taken(tab, inspector, folder / "viewer-ghost.png", lambda: tab.get_by_role("tab", name="Plots").click())

        setup, v = scattered("hopper", 64)
        inspector = Inspector(rolled(setup, 0.008, 1.0, v), port=8953)
        inspector.stage.place(list(range(64)))
        inspector.timeline.go(60)
        inspector.stage.look()
        taken(tab, inspector, folder / "viewer-worlds.png")

        taken(tab, Live(SCENES["hopper"](), dt=0.05, port=8954), folder / "viewer-live.png")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs"))
