"""The stage: everything that is drawn of one or two films at a frame, without any controls."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from pbfd_torch.errors import InputError
from pbfd_torch.viewer.bodies import GHOST, OWN, Bodies
from pbfd_torch.viewer.contacts import Contacts
from pbfd_torch.viewer.film import Film
from pbfd_torch.viewer.ground import Ground
from pbfd_torch.viewer.layout import MOST, View, offsets, view_of
from pbfd_torch.viewer.marks import Marks

ROOT = "/worlds"


class Stage:
    """Draws frames of a film, and of a `ghost` at the same times, into a scene.

    All of it hangs on one node, which is moved where the camera follows a motion: the camera itself stays the user's. Raises
    `InputError` for a ghost with other links."""

    def __init__(self, server: viser.ViserServer, film: Film, ghost: Film | None = None) -> None:
        if ghost is not None and ghost.rollout.link_names != film.rollout.link_names:
            names = ", ".join(ghost.rollout.link_names)
            raise InputError(f"the ghost has the links {names}: must be those of the other, {', '.join(film.rollout.link_names)}")
        self.film, self.ghost = film, ghost
        self.follows = film.travels
        self.server, self._frame = server, 0
        scene = server.scene
        self._root = scene.add_frame(ROOT, show_axes=False)
        scene.set_up_direction(film.appearance.up)
        _light(scene, np.array(film.appearance.up))
        self._ground = Ground(scene, f"{ROOT}/ground", film)
        self._bodies = Bodies(scene, f"{ROOT}/bodies", film, OWN)
        self._shadow = None if ghost is None else Bodies(scene, f"{ROOT}/ghost", ghost, GHOST, obstacles=False)
        self.contacts = Contacts(scene, f"{ROOT}/contacts", film)
        self.marks = Marks(scene, f"{ROOT}/marks", film)
        self.ghost_visible = ghost is not None
        self.worlds: list[int] = [0]
        self.place([0])

    def place(self, worlds: list[int]) -> None:
        """Draws these worlds, side by side, from now on; at most `MOST`."""
        with self.server.atomic():
            self.worlds = worlds[:MOST]
            self.places = offsets(self.film, len(self.worlds))
            self._ground.place(self.worlds, self.places)
            self._bodies.place(self.worlds, self.places)
            self.marks.place(self.worlds, self.places)
            if self._shadow is not None:
                assert self.ghost is not None
                shown = [(w, p) for w, p in zip(self.worlds, self.places, strict=True) if w < self.ghost.worlds]
                self._shadow_worlds = [w for w, _ in shown] if self.ghost_visible else []
                self._shadow.place(self._shadow_worlds, np.array([p for _, p in shown], np.float32).reshape(-1, 3))
            self.show(self._frame)

    def show(self, frame: int) -> None:
        """Draws a frame of all worlds."""
        film = self.film
        self._frame = frame
        with self.server.atomic():
            poses = film.poses(frame, self.worlds)
            self._bodies.show(poses)
            shift = self._shift(frame)
            self._ground.show(frame, -np.array(shift, np.float32))
            self.marks.show(frame, poses)
            self.contacts.show(frame, self.worlds, self.places)
            if self._shadow is not None and self.ghost is not None and self._shadow_worlds:
                same = min(round(frame * film.dt / self.ghost.dt), self.ghost.frames - 1)
                self._shadow.show(self.ghost.poses(same, self._shadow_worlds))
            self._root.position = shift

    def _shift(self, frame: int) -> tuple[float, float, float]:
        """Where the root is so that the first world's centre of mass stays in its place."""
        if not self.follows:
            return (0.0, 0.0, 0.0)
        moved = (self.film.home[self.worlds[0]] - self.film.center[frame, self.worlds[0]]).cpu().double().numpy()
        x, y, z = np.nan_to_num(moved).tolist()
        return x, y, z

    @property
    def view(self) -> View:
        """A camera that has everything in sight."""
        return view_of(self.film, self.places, self.follows)

    def look(self) -> None:
        """Gives every browser, those that come later too, that camera."""
        view, initial = self.view, self.server.initial_camera
        position, target = tuple(view.position.tolist()), tuple(view.target.tolist())
        initial.up = tuple(view.up.tolist())
        initial.position, initial.look_at, initial.fov = position, target, view.angle
        for client in self.server.get_clients().values():
            client.camera.up_direction = view.up
            client.camera.position, client.camera.look_at = view.position, view.target
            client.camera.fov = view.angle


def _light(scene: viser.SceneApi, up: NDArray[np.float64]) -> None:
    """A sun from the left behind the camera, which casts shadows, and a sky."""
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    x, y, z = (5 * up + np.array((-1.5, -3.0, 0.0))).tolist()
    scene.add_light_hemisphere("/sky", sky_color=(255, 255, 255), ground_color=(150, 145, 140), intensity=1.1)
    scene.add_light_directional("/sun", color=(255, 250, 240), intensity=2.0, cast_shadow=True, position=(x, y, z))
