"""The named scenes: every one runs, and starts as the benchmark of other simulators describes it."""

from __future__ import annotations

import math

import pytest
import torch

from pbfd_torch.balance.dynamics import center_of_mass, kinetic_energy, momentum
from pbfd_torch.contact.shapes import Point, Sphere
from pbfd_torch.models import SCENES, Setup
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.simulator import Simulator
from pbfd_torch.tree.articulation import pseudo_inertia
from pbfd_torch.tree.kinematics import Motion
from tests.scene_contacts import contact_of, depth, mu, start

G = 9.81
CHAINS_ON_GROUND = ["chain-ground", "chain-slope", "chain-slope-drop"]
CHAINS = ["chain-fixed", "chain-heavy", "chain-free", *CHAINS_ON_GROUND]
pytestmark = pytest.mark.filterwarnings("ignore::pbfd_torch.errors.NotModelledWarning")


def run(setup: Setup, steps: int) -> Rollout:
    simulator = Simulator(setup.scene, setup.dt)
    return simulator.rollout(simulator.initial_state(setup.q, setup.v), controls=setup.controls(steps))


def numbers(value: float | list[float]) -> list[float]:
    return value if isinstance(value, list) else [value]


# all of them --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("name", SCENES)
def test_every_scene_runs(name: str, worlds: int, dtype: torch.dtype) -> None:
    """Builds in the wanted number of worlds and type under its own name; three steps are solved; its metrics are finite numbers."""
    setup = SCENES[name](worlds=worlds, dtype=dtype)
    a = setup.scene.articulation
    assert (setup.scene.name, setup.worlds) == (name, worlds)
    assert (setup.q.shape, setup.v.shape) == ((worlds, a.nq), (worlds, a.nv))
    assert setup.q.dtype == setup.v.dtype == a.dtype == dtype
    rollout = run(setup, 3)
    assert bool(rollout.solved.all()), f"status {rollout.status.tolist()}"
    assert rollout.q.shape == (4, worlds, a.nq)
    assert bool(torch.isfinite(rollout.q).all())
    metrics = setup.metrics(rollout)
    assert all(math.isfinite(x) for value in metrics.values() for x in numbers(value))
    assert bool(metrics) == (name not in ("chain-ground", "hopper", "walker", "quadruped"))


DURATIONS = {"box-slide": 1.5, "box-slope": 5, "chain-fixed": 1, "chain-heavy": 1, "chain-free": 2, "chain-ground": 2}
DURATIONS |= {"chain-slope": 10, "chain-slope-drop": 10, "dzhanibekov": 10}


@pytest.mark.parametrize(("name", "duration"), DURATIONS.items())
def test_durations(name: str, duration: float) -> None:
    """As long as the other simulators ran; a whole number of steps."""
    setup = SCENES[name]()
    assert setup.duration == duration
    assert setup.duration / setup.dt == pytest.approx(round(setup.duration / setup.dt))


# boxes --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "boxes"), [("box-slide", 1), ("box-slope", 1)])
def test_box(name: str, boxes: int) -> None:
    """1 kg, .2 × .2 × .1 m of uniform density, spheres of 1 cm at the eight corners, each quarter of the weight on a lower one."""
    setup = SCENES[name](worlds=1)
    a = setup.scene.articulation
    assert a.nlink == boxes
    inertia = torch.diag(torch.tensor([0.2**2 + 0.1**2, 0.2**2 + 0.1**2, 0.2**2 + 0.2**2], dtype=torch.float64)) / 12
    expected = pseudo_inertia(torch.ones(1, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64), inertia[None])
    torch.testing.assert_close(a.pseudo_inertia, expected.expand(boxes, 4, 4), rtol=0, atol=1e-15)
    contact = contact_of(setup)
    assert len(contact.link) == 8 * boxes
    assert all(x.shape == Sphere(0.01) for x in setup.scene.colliders)
    torch.testing.assert_close(contact.position.abs(), contact.position.new_tensor([0.1, 0.1, 0.05]).expand(8 * boxes, 3))
    assert len({tuple(row) for row in contact.position.sign().tolist()}) == 8
    push, _ = contact.normal_force.force(depth(setup))
    weight = -float(setup.scene.gravity[2])
    torch.testing.assert_close(push.sort().values[0, -4 * boxes :], push.new_full((4 * boxes,), weight / 4))
    assert int((push > 0).sum()) == 4 * boxes


def test_box_slide() -> None:
    """μ = .1, .2, .3, .5, .8 in turn, level ground, 1 m/s along x and nothing else."""
    setup = SCENES["box-slide"](worlds=6)
    assert mu(setup) == [0.1, 0.2, 0.3, 0.5, 0.8, 0.1]
    assert setup.scene.gravity.tolist() == [0, 0, -G]
    assert setup.v.tolist() == [[1, 0, 0, 0, 0, 0]] * 6
    assert SCENES["box-slide"]().worlds == 5


def test_box_slope() -> None:
    """20°, downhill along +x: μ = 1.02 tan 20° holds, .98 tan 20° slides; at rest."""
    setup = SCENES["box-slope"](worlds=3)
    tan = math.tan(math.radians(20))
    assert mu(setup) == pytest.approx([1.02 * tan, 0.98 * tan, 1.02 * tan])
    expected = setup.q.new_tensor([G * math.sin(math.radians(20)), 0, -G * math.cos(math.radians(20))])
    torch.testing.assert_close(setup.scene.gravity, expected)
    assert not setup.v.any()
    assert SCENES["box-slope"]().worlds == 2


# chains -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CHAINS)
def test_links_of_a_chain(name: str) -> None:
    """Ten links: .1 m, .1 kg (the last 100 kg in chain-heavy), COM half-way, inertia of a rod of radius .02 m; hinges about +y,
    without limits, damping or armature; the root free, or hinged to the world at the origin."""
    setup = SCENES[name](worlds=1)
    a = setup.scene.articulation
    m, r, length = 0.1, 0.02, 0.1
    mass = torch.full((10,), m, dtype=torch.float64)
    mass[-1] = 100.0 if name == "chain-heavy" else m
    across = (3 * r**2 + length**2) / 12
    inertia = mass[:, None, None] * torch.diag(mass.new_tensor([r**2 / 2, across, across]))
    com = mass.new_tensor([length / 2, 0, 0]).expand(10, 3)
    torch.testing.assert_close(a.pseudo_inertia, pseudo_inertia(mass, com, inertia), rtol=1e-12, atol=1e-15)

    free = name not in ("chain-fixed", "chain-heavy")
    assert a.nv == (15 if free else 10)
    assert a.topology.joint_sizes[0] == ((7, 6) if free else (1, 1))
    hinges = a.joint_axis[1:] if free else a.joint_axis
    assert hinges.tolist() == [[0, 1, 0]] * len(hinges)
    assert bool(torch.isinf(a.lower).all())
    assert bool(torch.isinf(a.upper).all())
    kinds = [type(term).__name__ for term in setup.scene.terms]
    assert kinds == (["Inertia", "Contact"] if name in CHAINS_ON_GROUND else ["Inertia"])


@pytest.mark.parametrize("name", CHAINS)
def test_chain_starts_straight(name: str) -> None:
    """Every link's frame stands .1 m behind the one before it, in its direction; only chain-free moves."""
    setup = SCENES[name](worlds=2)
    poses = start(setup).poses[..., :3, :]
    torch.testing.assert_close(poses[:, 1:, :, :3], poses[:, :-1, :, :3], rtol=0, atol=1e-12)
    torch.testing.assert_close(poses[:, 1:, :, 3] - poses[:, :-1, :, 3], 0.1 * poses[:, :-1, :, 0], rtol=0, atol=1e-12)
    assert bool(setup.v.any()) == (name == "chain-free")


@pytest.mark.parametrize("name", CHAINS_ON_GROUND)
def test_chain_touches_with_its_skin(name: str) -> None:
    """Two candidates a link, at its ends on its axis, with a skin of the rod's radius."""
    setup = SCENES[name](worlds=1)
    contact = contact_of(setup)
    assert contact.link.tolist() == [k // 2 for k in range(20)]
    torch.testing.assert_close(contact.position, contact.position.new_tensor([[0, 0, 0], [0.1, 0, 0]]).repeat(10, 1))
    assert all(x.shape == Point() for x in setup.scene.colliders)
    assert contact.radius.tolist() == [0] * 20
    assert contact.margin.tolist() == [0.02] * 20


@pytest.mark.parametrize(
    ("name", "pitch", "clearance", "friction", "slope"),
    [("chain-ground", 30, 0.5, 0.5, 0), ("chain-slope-drop", -20, 0.1, 0.3, 30), ("chain-slope", 0, None, 0.3, 30)],
)
def test_dropped_chain(name: str, pitch: float, clearance: float | None, friction: float, slope: float) -> None:
    """Pitched with its far end down, or its near end on the slope: that end's skin is the lowest, exactly at the stated height
    above the ground; laid down, each of the 20 points carries as much of the weight. Gravity leans by the slope."""
    setup = SCENES[name](worlds=2)
    x_axis = start(setup).poses[:, 0, :3, 0]
    expected = x_axis.new_tensor([math.cos(math.radians(pitch)), 0, -math.sin(math.radians(pitch))])
    torch.testing.assert_close(x_axis, expected.expand(2, 3), rtol=0, atol=1e-12)
    assert mu(setup) == [friction]
    lean = math.radians(slope)
    torch.testing.assert_close(setup.scene.gravity, setup.q.new_tensor([G * math.sin(lean), 0, -G * math.cos(lean)]))
    if clearance is None:
        push, _ = contact_of(setup).normal_force.force(depth(setup))
        torch.testing.assert_close(push, push.new_full((2, 20), G * math.cos(lean) / 20))
    else:
        torch.testing.assert_close(depth(setup).amax(-1), setup.q.new_full((2,), -clearance), rtol=0, atol=1e-12)
        assert depth(setup)[0].argmax() == (19 if pitch > 0 else 0)


@pytest.mark.parametrize("name", ["chain-fixed", "chain-heavy"])
def test_hung_up_chain(name: str) -> None:
    """Horizontal along +x from the origin, gravity down."""
    setup = SCENES[name](worlds=1)
    poses = start(setup).poses
    assert poses[0, 0, :3, 3].tolist() == [0, 0, 0]
    torch.testing.assert_close(poses[0, 9, :3, 3], poses.new_tensor([0.9, 0, 0]))
    assert setup.scene.gravity.tolist() == [0, 0, -G]


def test_free_chain_turns_as_one_rigid_body() -> None:
    """Weightless; COM at 5 m/s along +x; 10 rad/s about +y through it: linear momentum m v, angular I ω, energy their sum's."""
    setup = SCENES["chain-free"](worlds=1)
    a = setup.scene.articulation
    assert not setup.scene.gravity.any()
    placement = start(setup)
    rates = Motion(placement, setup.v).rates
    linear, angular = momentum(placement, rates)
    torch.testing.assert_close(linear, linear.new_tensor([[5.0, 0, 0]]), rtol=0, atol=1e-12)
    moment = 10 * (0.1 * (3 * 0.02**2 + 0.1**2) / 12) + sum(0.1 * (0.1 * k + 0.05 - 0.5) ** 2 for k in range(10))
    torch.testing.assert_close(angular, angular.new_tensor([[0, 10 * moment, 0]]), rtol=0, atol=1e-12)
    energy = kinetic_energy(a, rates)
    torch.testing.assert_close(energy, energy.new_tensor([0.5 * 25 + 0.5 * moment * 100]))


# the spinning body --------------------------------------------------------------------------------------------------------


def test_dzhanibekov() -> None:
    """1 kg, weightless, COM at rest, 20 rad/s about the middle one of three different principal axes, slightly disturbed."""
    setup = SCENES["dzhanibekov"](worlds=2)
    a = setup.scene.articulation
    assert a.mass.tolist() == [1.0]
    assert not setup.scene.gravity.any()
    second = a.pseudo_inertia[0, :3, :3].diagonal()
    x, y, z = (second.sum() - second).tolist()
    assert x < 0.95 * y
    assert y < 0.95 * z
    torch.testing.assert_close(center_of_mass(start(setup)), torch.zeros(2, 3, dtype=torch.float64))
    assert setup.v[:, :3].tolist() == [[0, 0, 0]] * 2
    assert setup.v[0, 4] == 20
    assert 0 < float(setup.v[0, [3, 5]].abs().max()) < 0.1
