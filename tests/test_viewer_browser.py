"""The viewer in a real browser without a window: what a user drags, clicks and sees; and the page that plays from disk."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imageio import v3 as iio
from numpy.typing import NDArray

from pbfd_torch import Rollout, Simulator
from pbfd_torch.models import SCENES
from pbfd_torch.viewer import Inspector, Live, save_film, save_html, save_png
from pbfd_torch.viewer.browser import BROWSERS, page

Image = NDArray[np.uint8]
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(not any(map(shutil.which, BROWSERS)), reason="no Chromium or Chrome"),
]
PATIENCE = 30.0  # [s]
SLIDERS = ("Step", "World", "Side by side")  # from top to bottom
SCENE = {"x": 0, "y": 150, "width": 650, "height": 450}  # of the window: without the panel and a browser's notice


def rolled(dt: float, steps: int, worlds: int = 3) -> Rollout:
    setup = SCENES["chain-slope-drop"](worlds=worlds)
    v = setup.v.clone()
    v[1:, 4] = 2.0  # worlds that can be told apart
    simulator = Simulator(setup.scene, dt)
    return simulator.rollout(simulator.initial_state(setup.q, v), setup.controls(steps))


@pytest.fixture(scope="module")
def rollout() -> Rollout:
    return rolled(0.05, 24)


@pytest.fixture
def tab() -> Iterator[Any]:
    with page(1000, 600) as one:
        yield one


def until(true: Callable[[], bool]) -> None:
    """Waits for it."""
    ends = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < ends, "it did not happen"
        time.sleep(0.1)


def seen(tab: Any) -> Image:
    """The scene's pixels."""
    image: Image = iio.imread(tab.screenshot(clip=SCENE), extension=".png")[..., :3]
    return image


def changed(before: Image, after: Image) -> int:
    """How many pixels differ clearly."""
    return int((np.abs(before.astype(int) - after).max(-1) > 40).sum())


def settled(tab: Any) -> Image:
    """The scene once it no longer changes."""
    last = seen(tab)
    ends = time.monotonic() + PATIENCE
    while time.monotonic() < ends:
        time.sleep(0.4)
        now = seen(tab)
        if changed(last, now) < 20:
            return now
        last = now
    raise AssertionError("the scene does not come to rest")


def opened(tab: Any, shown: Inspector | Live, wait_for: str = "Contact points") -> None:
    tab.goto(shown.address)
    tab.wait_for_selector(f"text={wait_for}")
    time.sleep(1.0)


def drag(tab: Any, slider: str, share: float) -> None:
    """Takes the thumb of a slider to a share of its track."""
    row = tab.locator(".mantine-Slider-root").nth(SLIDERS.index(slider))
    thumb = row.locator(".mantine-Slider-thumb").bounding_box()
    track = row.locator(".mantine-Slider-track").bounding_box()
    assert thumb
    assert track
    tab.mouse.move(thumb["x"] + thumb["width"] / 2, thumb["y"] + thumb["height"] / 2)
    tab.mouse.down()
    tab.mouse.move(track["x"] + share * track["width"], thumb["y"] + thumb["height"] / 2, steps=8)
    tab.mouse.up()


def color_count(image: Image, color: tuple[int, int, int], within: int = 70) -> int:
    return int((np.abs(image.astype(int) - color).max(-1) < within).sum())


def test_scrub_play_and_toggle(tab: Any, rollout: Rollout) -> None:
    """Dragging the timeline moves the drawn chain and the server's frame; play and pause run the clock; contact forces show arrows;
    another world is drawn elsewhere."""
    inspector = Inspector(rollout, port=8610)
    try:
        inspector.stage.follows = False
        opened(tab, inspector)
        start = settled(tab)
        drag(tab, "Step", 0.5)
        until(lambda: 8 <= inspector.timeline.frame <= 16)
        middle = settled(tab)
        assert changed(start, middle) > 300
        assert "step" in tab.inner_text("body")

        tab.get_by_role("button", name="Play").click()
        before = inspector.timeline.frame
        until(lambda: inspector.timeline.playing and inspector.timeline.frame != before)
        tab.get_by_role("button", name="Pause").click()
        until(lambda: not inspector.timeline.playing)

        tab.get_by_text("last", exact=True).click()
        until(lambda: inspector.timeline.frame == rollout.steps)
        bare = settled(tab)
        tab.get_by_label("Contact forces").click()
        until(lambda: inspector.stage.contacts.forces)
        arrows = settled(tab)
        assert changed(bare, arrows) > 100

        drag(tab, "World", 1.0)
        until(lambda: inspector.stage.worlds == [2])
        assert changed(arrows, settled(tab)) > 100
    finally:
        inspector.close()


def test_ghost_is_drawn_over_and_can_be_hidden(tab: Any, rollout: Rollout) -> None:
    """A rollout at another Δt as a ghost: its colour is there, and gone once it is switched off."""
    inspector = Inspector(rollout, rolled(0.1, 12), port=8620)
    try:
        opened(tab, inspector, "Ghost")
        inspector.timeline.go(8)
        shown = settled(tab)
        tab.get_by_label("Ghost").click()
        until(lambda: not inspector.stage.ghost_visible)
        assert changed(shown, settled(tab)) > 100
    finally:
        inspector.close()


def test_page_plays_from_disk_without_network(tmp_path: Path, rollout: Rollout) -> None:
    """The saved page, opened from disk with the network off, moves by itself and asks for nothing."""
    file = tmp_path / "rollout.html"
    save_html(rollout, file, contacts=True)
    with page(1000, 600, offline=True) as tab:
        asked: list[str] = []
        tab.on("request", lambda request: asked.append(request.url) if request.url.startswith(("http", "ws")) else None)
        tab.goto(file.as_uri())
        tab.wait_for_selector("canvas")
        images: list[Image] = []

        def moves() -> bool:
            images.append(seen(tab))
            return any(changed(images[0], x) > 100 and changed(images[-1], x) > 50 for x in images)

        until(moves)
        assert asked == []


def test_still_and_films(tmp_path: Path, rollout: Rollout) -> None:
    """A still and two films have the wanted size, and frames that differ."""
    save_png(rollout, tmp_path / "still.png", frame=10, size=(320, 180))
    still = iio.imread(tmp_path / "still.png")
    assert still.shape[:2] == (180, 320)
    assert still.std() > 5
    counted = []
    for name in ("film.mp4", "film.gif"):
        save_film(rollout, tmp_path / name, size=(160, 96), progress=lambda done, whole: counted.append((done, whole)))
        frames = iio.imread(tmp_path / name)
        assert frames.shape[1:3] == (96, 160)
        assert len(frames) >= rollout.steps
        assert changed(frames[0, ..., :3], frames[-1, ..., :3]) > 10
    assert counted[-1] == (25, 25)


def test_live_steps_and_reacts(tab: Any) -> None:
    """The live chain falls on the ground; with Δt changed by hand it goes on; a reset brings it back to the start."""
    live = Live(SCENES["chain-ground"](), dt=0.05, port=8640)
    try:
        opened(tab, live, "Friction")
        until(lambda: live.steps > 5)
        fallen = live.q.clone()
        tab.get_by_role("button", name="Pause").click()
        until(lambda: "Go on" in tab.inner_text("body"))
        steps = live.steps
        time.sleep(0.5)
        assert live.steps <= steps + 1
        tab.get_by_role("button", name="Reset").click()
        until(lambda: live.steps == 0)
        assert float((live.q - fallen).abs().max()) > 1e-3
    finally:
        live.close()
