"""A rollout as a page that plays by itself, as a still or as a film; without a window."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import ParamSpec

import numpy as np
import viser
from numpy.typing import NDArray

from pbfd_torch.errors import InputError
from pbfd_torch.files import write_whole
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.viewer import server as serving
from pbfd_torch.viewer.browser import page
from pbfd_torch.viewer.film import Film
from pbfd_torch.viewer.stage import Stage

RATE = 30.0  # [frames/s] of films and pages at most
MOST_FRAMES = 3000  # of a page: it holds them all
FILMS = (".mp4", ".gif")
_WINDOW = (320, 240)  # of the browser, which draws that all the time besides the pictures
_LOADING = 30.0  # [s] that a browser may take to show up
_SETTLING = 1.5  # [s] after which shadows and meshes are there


P = ParamSpec("P")


def _apart(function: Callable[P, None]) -> Callable[P, None]:
    """The function in a thread of its own: a browser cannot be driven beside the event loop of a notebook."""

    @functools.wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> None:
        with ThreadPoolExecutor(1) as pool:
            pool.submit(function, *args, **kwargs).result()

    return alone


def frames_shown(film: Film, rate: float = RATE, most: int | None = None) -> tuple[NDArray[np.int64], float]:
    """Frames in real time, at most `rate` per second and `most` in all, and how long each is shown [s]."""
    every = max(1, round(1 / (rate * film.dt)))
    if most is not None:
        every = max(every, -(-film.frames // most))
    return np.arange(0, film.frames, every), every * film.dt


def save_html(
    rollout: Rollout, path: str | os.PathLike[str], ghost: Rollout | None = None, worlds: int = 1, contacts: bool = False
) -> None:
    """One page of its own that plays the rollout in any browser, from disk and without network. worlds: how many side by side.
    contacts: with points and forces. Raises `InputError` where it cannot be written."""
    target = _checked(Path(path), (".html",))
    with _stage(rollout, ghost, worlds, contacts) as stage:
        serializer = stage.server.get_scene_serializer()
        frames, pause = frames_shown(stage.film, most=MOST_FRAMES)
        for frame in frames:
            stage.show(int(frame))
            serializer.insert_sleep(pause)
        text = serializer.as_html()
    _write(target, text.encode())


@_apart
def save_png(
    rollout: Rollout,
    path: str | os.PathLike[str],
    frame: int | None = None,
    ghost: Rollout | None = None,
    worlds: int = 1,
    contacts: bool = False,
    size: tuple[int, int] = (1280, 720),
) -> None:
    """A still of a frame (None: in the middle), `size` pixels wide and high. Raises `InputError` for a frame that does not exist,
    and where there is no browser."""
    target = _checked(Path(path), (".png",))
    film = Film(rollout)
    frame = film.frames // 2 if frame is None else frame
    if not 0 <= frame < film.frames:
        raise InputError(f"frame is {frame}: must be from 0 to {film.frames - 1}")
    from imageio import v3 as iio

    with _stage(rollout, ghost, worlds, contacts) as stage, _camera(stage, size) as picture:
        stage.show(frame)
        time.sleep(_SETTLING)
        still: bytes = iio.imwrite("<bytes>", picture(), extension=".png")
        _write(target, still)


@_apart
def save_film(
    rollout: Rollout,
    path: str | os.PathLike[str],
    ghost: Rollout | None = None,
    worlds: int = 1,
    contacts: bool = False,
    size: tuple[int, int] = (960, 540),
    progress: Callable[[int, int], object] | None = None,
) -> None:
    """An .mp4 (H.264) or .gif in real time. progress: called with the number of frames done and their number. Raises `InputError`
    where there is no browser or, for an .mp4, no encoder."""
    target = _checked(Path(path), FILMS)
    if target.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise InputError("an .mp4 needs the package imageio-ffmpeg (pip install 'pbfd_torch[film]'); a .gif does not")
    from imageio import v3 as iio

    with _stage(rollout, ghost, worlds, contacts) as stage, _camera(stage, size) as picture:
        frames, pause = frames_shown(stage.film, RATE if target.suffix == ".mp4" else 20.0)
        time.sleep(_SETTLING)
        images = []
        for done, frame in enumerate(frames, 1):
            stage.show(int(frame))
            images.append(picture())
            if progress is not None:
                progress(done, len(frames))
        options = {"fps": 1 / pause, "codec": "h264"} if target.suffix == ".mp4" else {"duration": 1e3 * pause, "loop": 0}
        with tempfile.TemporaryDirectory() as folder:
            part = Path(folder) / f"film{target.suffix}"
            iio.imwrite(part, np.stack(images), **options)
            _write(target, part.read_bytes())


@contextlib.contextmanager
def _stage(rollout: Rollout, ghost: Rollout | None, worlds: int, contacts: bool) -> Iterator[Stage]:
    film = Film(rollout)
    if not 1 <= worlds <= film.worlds:
        raise InputError(f"worlds is {worlds}: must be from 1 to {film.worlds}")
    server = serving.start(port=serving.PORT + 500, quiet=True)
    try:
        stage = Stage(server, film, None if ghost is None else Film(ghost))
        stage.contacts.points = stage.contacts.forces = contacts
        stage.place(list(range(worlds)))
        stage.look()
        yield stage
    finally:
        serving.stop(server)


@contextlib.contextmanager
def _camera(stage: Stage, size: tuple[int, int]) -> Iterator[Callable[[], NDArray[np.uint8]]]:
    """Takes pictures of the stage through a browser without a window."""
    with page(*_WINDOW) as tab:
        tab.goto(serving.address(stage.server))
        client = _client(stage.server)
        view = stage.view
        z = (view.target - view.position) / np.linalg.norm(view.target - view.position)
        x = np.cross(z, view.up)
        turn = viser.transforms.SO3.from_matrix(np.stack((x / np.linalg.norm(x), np.cross(z, x / np.linalg.norm(x)), z), 1))

        def picture() -> NDArray[np.uint8]:
            stage.server.flush()
            image: NDArray[np.uint8] = client.get_render(
                size[1], size[0], wxyz=turn.wxyz, position=view.position, fov=view.angle, transport_format="jpeg"
            )
            return image[..., :3]

        yield picture


def _client(server: viser.ViserServer) -> viser.ClientHandle:
    ends = time.monotonic() + _LOADING
    while time.monotonic() < ends:
        clients = server.get_clients()
        if clients:
            return next(iter(clients.values()))
        time.sleep(0.1)
    raise InputError(f"the browser did not open the scene within {_LOADING:g} s")


def _checked(target: Path, suffixes: tuple[str, ...]) -> Path:
    """The path, if it can be written as what it says it is."""
    if target.suffix not in suffixes:
        raise InputError(f"'{target}' must end in {' or '.join(suffixes)}")
    if target.is_dir():
        raise InputError(f"'{target}' is a folder")
    return target


def _write(target: Path, content: bytes) -> None:
    """The whole file or none."""
    try:
        write_whole(target, content)
    except OSError as error:
        raise InputError(f"cannot write '{target}': {error.strerror or error}") from error
