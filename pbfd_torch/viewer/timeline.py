"""The timeline: which frame is shown, moved by hand or by a clock, with a strip that marks how each step was solved."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from pbfd_torch.solvers.objective import Status
from pbfd_torch.viewer.film import Film

RATE = 30.0  # frames per second that are drawn at most while it plays
SPEEDS = {"1/10 ×": 0.1, "1/4 ×": 0.25, "1/2 ×": 0.5, "1 ×": 1.0, "2 ×": 2.0, "4 ×": 4.0}
_UNSOLVED, _EASED, _HALVED, _DETOUR = "#d6192b", "#e8a013", "#8b5cd6", "#8fb3d9"
_STRIP = 400  # columns of the strip at most


class Timeline:
    """Controls of the frame shown. `show(frame)` is called whenever it changes, never twice at the same time."""

    def __init__(self, gui: viser.GuiApi, film: Film, show: Callable[[int], None]) -> None:
        self._film, self._show = film, show
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._clock: threading.Thread | None = None
        self.frame = 0
        self._words = gui.add_markdown(self._text())
        self._slider: Any = gui.add_slider("Step", 0, max(1, film.frames - 1), 1, 0, hint="Drag to scrub through the steps.")
        self._strip = gui.add_html(strip(film))
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        moves = gui.add_button_group("Go", ("first", "back", "next", "last"))
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1 ×")
        self._loop = gui.add_checkbox("Loop", True)

        @self._slider.on_update
        def _(event: viser.GuiEvent[viser.GuiSliderHandle[int]]) -> None:
            if event.client_id is not None:  # moved by hand, not by `go`
                self.go(int(self._slider.value), follow=False)

        @self._play.on_click
        def _(_: object) -> None:
            if self.playing:
                self.pause()
            else:
                self.play()

        @moves.on_click
        def _(_: object) -> None:
            last = self._film.frames - 1
            self.pause()
            self.go({"first": 0, "back": self.frame - 1, "next": self.frame + 1, "last": last}[str(moves.value)])

    @property
    def playing(self) -> bool:
        """Whether the clock runs."""
        return self._clock is not None

    def go(self, frame: int, follow: bool = True) -> None:
        """Shows a frame, the nearest that exists. follow: move the slider with it."""
        with self._lock:
            self.frame = min(max(frame, 0), self._film.frames - 1)
            self._show(self.frame)
            self._words.content = self._text()
            if follow:
                self._slider.value = self.frame

    def play(self) -> None:
        """Starts the clock, at the beginning where the end is reached."""
        with self._lock:
            if self.playing:
                return
            if self.frame == self._film.frames - 1:
                self.go(0)
            self._stop.clear()
            self._clock = threading.Thread(target=self._run, name="timeline", daemon=True)
            self._play.label, self._play.icon = "Pause", viser.Icon.PLAYER_PAUSE
            self._clock.start()

    def pause(self) -> None:
        """Stops the clock."""
        clock, self._clock = self._clock, None
        self._stop.set()
        if clock is not None:
            self._play.label, self._play.icon = "Play", viser.Icon.PLAYER_PLAY
            if clock is not threading.current_thread():
                clock.join(1.0)

    def _run(self) -> None:
        last, dt = self._film.frames - 1, self._film.dt
        at, before = self.frame * dt, time.perf_counter()
        shown = self.frame
        while not self._stop.wait(1 / RATE):
            if self.frame != shown:  # scrubbed meanwhile
                at = self.frame * dt
            now = time.perf_counter()
            at, before = at + (now - before) * SPEEDS[self._speed.value], now
            if at > last * dt:
                if not self._loop.value:
                    self.go(last)
                    self.pause()
                    return
                at %= max(last * dt, dt)
            frame = int(at / dt + 1e-6)
            if frame != self.frame:
                self.go(frame)
            shown = self.frame

    def mark(self, world: int) -> None:
        """Marks how a world's steps were solved."""
        self._strip.content = strip(self._film, world)

    def _text(self) -> str:
        film = self._film
        return f"**{self.frame * film.dt:.3f} s** · step {self.frame} of {film.frames - 1} · Δt = {film.dt:g} s"


def strip(film: Film, world: int = 0) -> str:
    """A bar over the steps as HTML: unsolved ones red, eased and halved ones and other detours in their colours; and a legend."""
    status: NDArray[np.int64] = film.rollout.status.reshape(film.rollout.steps, film.worlds)[:, world].cpu().numpy()
    ranks = np.zeros(len(status), int)
    for rank, kinds in enumerate(((Status.WARM_STARTED, Status.CONTINUED), (Status.EASED,), (Status.HALVED,)), 1):
        ranks[np.isin(status, [int(x) for x in kinds])] = rank
    ranks[status >= int(Status.STALLED)] = 4
    colors = ("", _DETOUR, _EASED, _HALVED, _UNSOLVED)
    columns = min(len(ranks), _STRIP)
    worst = [part.max() for part in np.array_split(ranks, columns)]
    width = 100 / columns
    wide = max(width, 0.6)
    bars = "".join(
        f'<rect x="{k * width:.3f}%" width="{wide:.3f}%" height="10" fill="{colors[rank]}"/>'
        for k, rank in enumerate(worst)
        if rank
    )
    names = ("", "other detours", "eased", "halved", "unsolved")
    counts = [(rank, int((ranks == rank).sum())) for rank in (4, 3, 2, 1)]
    said = [f'<span style="color:{colors[rank]}">■</span> {count} {names[rank]}' for rank, count in counts if count]
    legend = ", ".join(said) or "every step solved at once"
    return (
        '<div style="margin:0 0.8em 0.6em;font-size:0.75em">'
        f'<svg width="100%" height="10" style="background:#e4e7ec;border-radius:3px">{bars}</svg>'
        f"<div>{legend}</div></div>"
    )
