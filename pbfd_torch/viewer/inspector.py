"""The rollout inspector: stage, timeline, toggles and plots, in a browser."""

from __future__ import annotations

from collections.abc import Sequence

import viser

from pbfd_torch.records.rollout import Rollout
from pbfd_torch.viewer import server as serving
from pbfd_torch.viewer.film import Film
from pbfd_torch.viewer.layout import MOST
from pbfd_torch.viewer.plots import Plot
from pbfd_torch.viewer.served import Served
from pbfd_torch.viewer.stage import Stage
from pbfd_torch.viewer.timeline import Timeline


class Inspector(Served):
    """Shows a rollout, and a `ghost` over it, at an `address` for browsers, until `close`.

    host, port: where; by default only this computer can see it, and the next free port is taken where the wanted one is not free.
    origins: of web pages elsewhere that may connect, see `viewer.origins`. Raises `InputError` for a host, port or origin that
    cannot be used, and for a ghost with other links."""

    def __init__(
        self,
        rollout: Rollout,
        ghost: Rollout | None = None,
        host: str = serving.HOST,
        port: int = serving.PORT,
        origins: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self.film, self._ghost = Film(rollout), None if ghost is None else Film(ghost)
        self.server = serving.start(host, port, origins=origins)
        try:
            self.stage = Stage(self.server, self.film, self._ghost)
            self._build(self.server.gui)
            self.stage.look()
            self.timeline.go(0)
        except BaseException:
            self.close()
            raise

    def _ended(self) -> None:
        if hasattr(self, "timeline"):
            self.timeline.pause()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.address}" width="100%" height="560" style="border:1px solid #ccc"></iframe>'

    def _build(self, gui: viser.GuiApi) -> None:
        film = self.film
        gui.add_markdown(_title(film.rollout, None if self._ghost is None else self._ghost.rollout))
        self._plots: list[Plot] = []
        self.timeline = Timeline(gui, film, self._show)
        if film.worlds > 1:
            self._add_world_controls(gui)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Draw"):
            self._add_toggles(gui)
        with tabs.add_tab("Plots"):
            self._plots += [Plot(gui, film, self._ghost, first) for first in ("energy [J]", "iterations")]

    def _show(self, frame: int) -> None:
        self.stage.show(frame)
        for plot in self._plots:
            plot.move(frame * self.film.dt, self.timeline.playing)

    def _redraw(self) -> None:
        self.stage.place(self.stage.worlds)
        self.timeline.go(self.timeline.frame)

    def _add_world_controls(self, gui: viser.GuiApi) -> None:
        film = self.film
        world = gui.add_slider("World", 0, film.worlds - 1, 1, 0)
        beside = gui.add_slider("Side by side", 1, min(MOST, film.worlds), 1, 1, hint="How many worlds, from this one on.")

        def turn(_: object) -> None:
            first = int(world.value)
            self.stage.place([(first + k) % film.worlds for k in range(int(beside.value))])
            self.timeline.mark(first)
            for plot in self._plots:
                plot.turn_to(first)
            self.timeline.go(self.timeline.frame)

        def spread(event: object) -> None:
            turn(event)
            self.stage.look()

        world.on_update(turn)
        beside.on_update(spread)

    def _add_toggles(self, gui: viser.GuiApi) -> None:
        stage, contacts, marks = self.stage, self.stage.contacts, self.stage.marks

        def toggle(label: str, owner: object, name: str, hint: str) -> viser.GuiCheckboxHandle:
            box = gui.add_checkbox(label, bool(getattr(owner, name)), hint=hint)

            @box.on_update
            def _(_: object) -> None:
                setattr(owner, name, box.value)
                self._redraw()

            return box

        def stretch(label: str, name: str, most: float, step: float, hint: str) -> None:
            slider = gui.add_slider(label, step, most, step, getattr(contacts, name), hint=hint)

            @slider.on_update
            def _(_: object) -> None:
                setattr(contacts, name, float(slider.value))
                self._redraw()

        if self._ghost is not None:
            toggle("Ghost", stage, "ghost_visible", "The other rollout, at the same time.")
        toggle("Follow", stage, "follows", "Keep the centre of mass of the first world in its place.")
        with gui.add_folder("Contacts"):
            toggle("Contact points", contacts, "points", "Green: sticks. Orange: slides, on the friction cone.")
            toggle("Contact forces", contacts, "forces", "Blue: normal force. Green or orange: friction. Impacts are cut off.")
            stretch("Force scale", "scale", 5.0, 0.1, "Length of the arrows.")
            toggle("Penetration", contacts, "depths", "Red: how deep, stretched.")
            stretch("Depth scale", "depth_scale", 200.0, 5.0, "How many times deeper the arrows are than the contacts.")
        with gui.add_folder("Marks"):
            toggle("Link frames", marks, "frames", "Red, green, blue: x, y, z.")
            toggle("Joint axes", marks, "axes", "Hinges and slides.")
            toggle("Centre of mass", marks, "centers", "Of each world.")
            toggle("Trails", marks, "trails", "The path of each centre of mass.")
        look = gui.add_button("Reset camera", icon=viser.Icon.CAMERA)
        look.on_click(lambda _: stage.look())


def _title(rollout: Rollout, ghost: Rollout | None) -> str:
    unsolved = int((~rollout.solved).sum())
    words = f"### {rollout.scene_name}\n{_count(rollout)}"
    if unsolved:
        words += f" · **{unsolved} steps unsolved**"
    return words if ghost is None else f"{words}  \nghost: {ghost.scene_name}, {_count(ghost)}"


def _count(rollout: Rollout) -> str:
    worlds = rollout.q[0, ..., 0].numel()
    return f"{worlds} world{'s' if worlds > 1 else ''} · {rollout.steps} steps · Δt = {rollout.dt:g} s"
