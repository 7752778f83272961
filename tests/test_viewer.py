"""What the viewer shows, without a browser: frames, contacts, layout, curves, ports, and files that it must refuse."""

from __future__ import annotations

import dataclasses
import json
import math
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pbfd_torch import InputError, Rollout, Simulator, Status
from pbfd_torch.contact.motion import Turntable
from pbfd_torch.models import SCENES
from pbfd_torch.tree.rotations import quaternion_matrix
from pbfd_torch.viewer import Inspector
from pbfd_torch.viewer import server as serving
from pbfd_torch.viewer.export import frames_shown, save_html, save_png
from pbfd_torch.viewer.film import Film, quaternions
from pbfd_torch.viewer.layout import offsets, view_of
from pbfd_torch.viewer.live import with_friction
from pbfd_torch.viewer.series import Curves, quantities, thinned
from pbfd_torch.viewer.timeline import strip


def rolled(name: str = "chain-slope-drop", steps: int = 12, worlds: int = 2, dt: float = 0.05) -> Rollout:
    setup = SCENES[name](worlds=worlds)
    simulator = Simulator(setup.scene, dt)
    return simulator.rollout(simulator.initial_state(setup.q, setup.v), setup.controls(steps))


@pytest.fixture(scope="module")
def rollout() -> Rollout:
    return rolled()


def test_the_viewer_is_loaded_only_when_it_is_used() -> None:
    """`import pbfd_torch` and the command's help load neither viser nor trimesh."""
    code = "import sys, pbfd_torch, pbfd_torch.cli.main; assert not {'viser', 'trimesh', 'playwright'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


# Frames ---------------------------------------------------------------------------------------------------------------


def test_quaternions_of_rotations() -> None:
    """The matrices of the quaternions of 500 random rotations and of half turns about the axes are the rotations, to 1e-6; what is
    no rotation gives (1, 0, 0, 0)."""
    q = torch.nn.functional.normalize(torch.randn(500, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), dim=-1)
    q = torch.cat((q, torch.eye(4, dtype=torch.float64)))
    found = torch.from_numpy(quaternions(quaternion_matrix(q).numpy().astype(np.float32))).double()
    torch.testing.assert_close(quaternion_matrix(found), quaternion_matrix(q), atol=1e-6, rtol=0)
    assert quaternions(np.full((3, 3), np.nan, np.float32)).tolist() == [1, 0, 0, 0]


def test_frames_hold_links_obstacles_and_the_world(rollout: Rollout) -> None:
    """Poses of a frame are those of the record, links first, then obstacles, then the world; a batch of any shape is one axis."""
    film = Film(rollout)
    poses = film.poses(7, [1])
    np.testing.assert_allclose(poses[0, :10], rollout.link_poses[7, 1].numpy(), atol=1e-6)
    np.testing.assert_array_equal(poses[0, -1], np.eye(3, 4))
    assert poses.shape[1] == 10 + 1 + 1
    setup = SCENES["chain-free"](worlds=6)
    simulator = Simulator(setup.scene, 0.02)
    q, v = setup.q.reshape(2, 3, -1), setup.v.reshape(2, 3, -1).clone()
    v[1, 2, 0] = 1.0
    wide = Film(simulator.rollout(simulator.initial_state(q, v), steps=3))
    assert wide.worlds == 6
    np.testing.assert_allclose(wide.poses(3, [5])[0, 0], wide.rollout.link_poses[3, 1, 2, 0].numpy(), atol=1e-6)


def test_moving_obstacles_are_where_they_are() -> None:
    """The disc of the turntable turns with its motion."""
    rollout = rolled("turntable", steps=10, worlds=1, dt=0.02)
    film = Film(rollout)
    disc = film.appearance.visuals[-1]
    assert disc.body == 2
    turned = film.poses(10, [0])[0, 2, :, :3] @ film.poses(0, [0])[0, 2, :, :3].T
    (motion,) = (x.motion for x in SCENES["turntable"]().scene.obstacles)
    assert isinstance(motion, Turntable)
    assert math.atan2(turned[1, 0], turned[0, 0]) == pytest.approx(motion.rate * 0.2, abs=1e-5)


def test_contact_forces_fall_into_push_and_grip(rollout: Rollout) -> None:
    """Push + grip is the recorded force; the push is along the normal, the grip across; |grip| ≤ μ |push|; what slides has all of
    it; there are none at the start."""
    film = Film(rollout)
    assert len(film.touches(0, [0, 1]).point) == 0
    at = film.touches(12, [0, 1])
    assert len(at.point) > 4
    force = rollout.contact_force[11].numpy()
    np.testing.assert_allclose(at.push + at.grip, force[np.abs(force).max(-1) > 0], rtol=1e-5, atol=1e-5)
    push, grip = (np.linalg.norm(x, axis=-1) for x in (at.push, at.grip))
    assert bool((np.abs((at.grip * at.normal).sum(-1)) <= 1e-4 * push.max()).all())
    assert bool((grip <= 0.3 * push * (1 + 1e-4)).all())
    np.testing.assert_allclose(grip[at.slides], 0.3 * push[at.slides], rtol=1e-3)
    assert bool(at.slides.any())


def test_poses_that_are_not_finite_are_drawn_as_nothing(rollout: Rollout) -> None:
    """NaN in the record of one world: its poses become zeros, and another world's stay."""
    poses = rollout.link_poses.clone()
    poses[3:, 1] = math.nan
    film = Film(dataclasses.replace(rollout, link_poses=poses))
    assert bool(np.isfinite(film.poses(5, [0, 1])).all())
    np.testing.assert_allclose(film.poses(5, [0])[0, :10], rollout.link_poses[5, 0].numpy(), atol=1e-6)


# Layout ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["box-slide", "chain-free", "chain-slope-drop", "walker"])
def test_worlds_side_by_side_do_not_touch(name: str) -> None:
    """64 places, the first at the origin; the room that each world takes overlaps no other's; the camera sees all of them."""
    film = Film(rolled(name, 5, 2, 0.02))
    places = offsets(film, 64)
    assert places[0].tolist() == [0, 0, 0]
    apart = np.abs(places[:, None] - places[None])[..., :2]
    beside = (apart >= film.reach[:2] - 1e-6).any(-1)
    assert bool(beside[~np.eye(64, dtype=bool)].all())
    view = view_of(film, places, film.travels)
    low, high = film.bounds(0)
    corners = np.stack([low + places, high + places]).reshape(-1, 3) - view.position
    forward = (view.target - view.position) / np.linalg.norm(view.target - view.position)
    cosine = corners @ forward / np.linalg.norm(corners, axis=-1)
    assert math.acos(float(cosine.min())) < 0.75 * view.angle


# Time -----------------------------------------------------------------------------------------------------------------


def test_thinned_curves_keep_peaks() -> None:
    """Of 10⁵ points some hundred are left, with the one peak and the one dip among them, over the same time."""
    time = np.linspace(0, 10, 100_000)
    curve = np.sin(time)
    curve[31_234], curve[77_777] = 9.0, -9.0
    few = thinned(Curves(time, {"y": curve}))
    assert len(few.time) <= 600
    assert (few.lines["y"].max(), few.lines["y"].min()) == (9.0, -9.0)
    assert few.time[0] == 0
    assert few.time[-1] > 9.9
    assert bool((np.diff(few.time) > 0).all())


def test_every_quantity_has_curves(rollout: Rollout) -> None:
    """All of them, for both worlds, finite, as long as their times; energies add up; a free joint has seven coordinates."""
    film = Film(rollout)
    choices = quantities(film)
    assert len(choices) == 7 + 10
    for make in choices.values():
        for world in range(2):
            curves = make(world)
            assert all(len(y) == len(curves.time) and bool(np.isfinite(y).all()) for y in curves.lines.values())
    energy = choices["energy [J]"](1).lines
    np.testing.assert_allclose(energy["total"], energy["kinetic"] + energy["potential"])
    assert len(choices["joint root"](0).lines) == 7
    np.testing.assert_allclose(choices["joint hinge3"](1).lines["q"], rollout.q[:, 1, 9].numpy())


def test_strip_marks_how_steps_were_solved(rollout: Rollout) -> None:
    """Unsolved steps are red where they are, and counted; without any it says so."""
    assert "every step solved at once" in strip(Film(_with_status(rollout, Status.SOLVED)))
    status = _with_status(rollout, Status.SOLVED).status.clone()
    status[6, 1], status[2, 1] = int(Status.STALLED), int(Status.HALVED)
    marked = strip(Film(dataclasses.replace(rollout, status=status)), 1)
    assert 'x="50.000%"' in marked
    assert "1 unsolved" in marked
    assert "1 halved" in marked
    assert "unsolved" not in strip(Film(dataclasses.replace(rollout, status=status)), 0)


def _with_status(rollout: Rollout, status: Status) -> Rollout:
    return dataclasses.replace(rollout, status=torch.full_like(rollout.status, int(status)))


def test_films_are_in_real_time(rollout: Rollout) -> None:
    """Steps of .05 s are shown one by one, each for .05 s; finer ones are skipped to 30 a second, and to a number at most."""
    frames, pause = frames_shown(Film(rollout))
    assert frames.tolist() == list(range(13))
    assert pause == pytest.approx(0.05)
    frames, pause = frames_shown(Film(rolled(steps=40, worlds=1, dt=0.002)))
    assert pause == pytest.approx(0.034, abs=0.002)
    assert len(frames_shown(Film(rollout), most=5)[0]) <= 5


# Serving --------------------------------------------------------------------------------------------------------------


def test_a_taken_port_gives_the_next_one(rollout: Rollout, capsys: pytest.CaptureFixture[str]) -> None:
    """Only this computer is served; the next free port is taken and said; closing twice is no error."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        inspector = Inspector(rollout, port=taken)
        try:
            assert inspector.server.get_host() == "127.0.0.1"
            assert inspector.server.get_port() > taken
            said = capsys.readouterr()
            assert f"port {taken} is taken: using {inspector.server.get_port()}" in said.err
            assert said.out == ""
            assert str(inspector.server.get_port()) in inspector.address
        finally:
            inspector.close()
        inspector.close()


@pytest.mark.parametrize(("host", "port"), [("127.0.0.1", 0), ("127.0.0.1", 70000), ("no.such.host.invalid", 8080)])
def test_bad_addresses_are_refused(host: str, port: int) -> None:
    with pytest.raises(InputError, match=r"port is|host is"):
        serving.start(host, port)


def test_inspector_moves_in_time_and_between_worlds(rollout: Rollout) -> None:
    """Frames beyond the ends are the ends; bodies are drawn where the record has them."""
    inspector = Inspector(rollout, port=8700)
    try:
        inspector.timeline.go(99)
        assert inspector.timeline.frame == 12
        inspector.stage.follows = False
        inspector.stage.place([1, 0])
        inspector.timeline.go(-5)
        assert inspector.timeline.frame == 0
        inspector.timeline.go(6)
        drawn = np.concatenate([x.handle.batched_positions.reshape(2, -1, 3) for x in inspector.stage._bodies._surfaces], 1)
        expected = rollout.link_poses[6, [1, 0], :, :, 3].numpy() + inspector.stage.places[:, None]
        np.testing.assert_allclose(np.sort(drawn, 1), np.sort(expected, 1), atol=1e-5)
    finally:
        inspector.close()


def test_a_ghost_of_another_robot_is_refused(rollout: Rollout) -> None:
    with pytest.raises(InputError, match="the ghost has the links"):
        Inspector(rollout, rolled("hopper", 2), port=8710)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda r, p: save_html(r, p / "x.txt"), "must end in .html"),
        (lambda r, p: save_html(r, p / "x.html", worlds=3), "must be from 1 to 2"),
        (lambda r, p: save_png(r, p / "x.png", frame=13), "must be from 0 to 12"),
    ],
)
def test_bad_requests_for_files_are_refused(rollout: Rollout, tmp_path: Path, call: Any, words: str) -> None:
    """With words that name the range, and no file is left."""
    with pytest.raises(InputError, match=words):
        call(rollout, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_friction_of_all_contacts_is_set() -> None:
    """On the hopper, whose candidates have μ of their own, and on a chain: boxes of friction laws all say the new μ."""
    for name in ("hopper", "chain-ground", "mesh-terrain"):
        scene = with_friction(SCENES[name]().scene, 0.15)
        for term in scene.terms:
            law, grip = getattr(term, "friction", None), getattr(term, "grip", None)
            if law is not None:
                whole = torch.as_tensor(law.mu) * (1.0 if grip is None else grip)
                assert bool((whole - 0.15).abs().max() < 1e-12)


# Files ----------------------------------------------------------------------------------------------------------------


def altered(rollout: Rollout, path: Path, **changes: Any) -> Path:
    """A saved rollout with some of its arrays replaced; `meta`: a function of the parsed text."""
    rollout.save(path)
    with np.load(path) as file:
        arrays = dict(file)
    if "meta" in changes:
        changes["meta"] = np.array(json.dumps(changes["meta"](json.loads(str(arrays["meta"])))))
    np.savez(path, **(arrays | changes))
    return path


def test_saved_looks_come_back(rollout: Rollout, tmp_path: Path) -> None:
    """Surfaces, planes, joints and the vertical, bit for bit."""
    rollout.save(tmp_path / "x.npz")
    a, b = rollout.appearance, Rollout.load(tmp_path / "x.npz").appearance
    assert (a.planes, a.joints, a.up) == (b.planes, b.joints, b.up)
    for x, y in zip(a.visuals, b.visuals, strict=True):
        assert (x.name, x.body, x.color) == (y.name, y.body, y.color)
        np.testing.assert_array_equal(x.vertices, y.vertices)
        np.testing.assert_array_equal(x.faces, y.faces)


def test_hostile_files_are_refused(rollout: Rollout, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pickles are never loaded; other versions, arrays that do not fit each other, faces of no vertices, bodies that do not exist
    and files that claim to be enormous are refused, each with words that name it."""
    path = tmp_path / "x.npz"

    class Trap:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return Path.touch, (Path(tmp_path / "sprung"),)  # type: ignore[return-value]

    cases: list[tuple[dict[str, Any], str]] = [
        ({"q": np.array([Trap()], dtype=object)}, "pickle"),
        ({"meta": lambda m: m | {"format": "pbfd_torch rollout 4"}}, "format 'pbfd_torch rollout 4': must be"),
        ({"v": np.zeros((3, 2, 15))}, "v has shape"),
        ({"status": np.zeros((12, 2))}, "status is torch.float64"),
        ({"link_poses": np.zeros((13, 2, 9, 3, 4))}, "link_poses has shape"),
        ({"visual_faces": np.full((7680, 3), 10**6, np.int32)}, "faces"),
        ({"visual_vertices": np.zeros((3, 3), np.float32)}, "lacks vertices"),
        ({"meta": lambda m: m | {"link_names": 7}}, "not a readable rollout"),
        ({"meta": lambda m: {k: v for k, v in m.items() if k != "appearance"}}, "not a readable rollout"),
        ({"meta": lambda m: m | {"dt": -1.0}}, "dt is -1.0"),
    ]
    for changes, words in cases:
        with pytest.raises(InputError, match=words):
            Rollout.load(altered(rollout, path, **changes))
    assert not (tmp_path / "sprung").exists()

    def elsewhere(meta: dict[str, Any]) -> dict[str, Any]:
        meta["appearance"]["visuals"][0]["body"] = 99
        return meta

    with pytest.raises(InputError, match="body 99 does not exist"):
        Rollout.load(altered(rollout, path, meta=elsewhere))
    np.save(tmp_path / "single.npy", np.zeros(3))
    with pytest.raises(InputError, match="single array"):
        Rollout.load(tmp_path / "single.npy")
    rollout.save(path)
    monkeypatch.setattr("pbfd_torch.memory.available", lambda: 2000)
    with pytest.raises(InputError, match="claims"):
        Rollout.load(path)
