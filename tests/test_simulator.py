"""The simulator's interface: bad input refused by name, shapes of records, files, interruptions, and actuators that do as told."""

from __future__ import annotations

import dataclasses
import json
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch import Articulation, InputError, Joint, JointKind, Link, ModelError, Rollout, Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Capsule, Collider, ConvexHull, Cylinder, Ellipsoid, Sphere
from pbfd_torch.models.chains import chain_fixed, chain_ground, chain_slope_drop
from pbfd_torch.records.rollout import FORMAT
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from tests.bodies import GRAVITY, at, diagonal, down, free_body, on_ground, on_world, rises, rolled_out
from tests.states import implicit

BATCHES: list[tuple[int, ...]] = [(), (3,), (2, 3)]
all_batches = pytest.mark.parametrize("batch", BATCHES, ids=str)


def ball(friction: CoulombFriction | None = None) -> Scene:
    """A sphere over the ground."""
    return on_ground(free_body(1.0, diagonal(0.001, 0.001, 0.001)), Sphere(0.05), NormalForce(1e6), friction)


def arm(*actuators: Actuator, gravity: Tensor | None = None) -> Scene:
    """One slide along x, 2 kg, with actuators."""
    scene = on_world(JointKind.SLIDE, 2.0, gravity=gravity)
    return dataclasses.replace(scene, terms=(Inertia(), Actuators.from_list(scene.articulation, actuators)))


def doubles(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


# Bad input ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.0, -0.01, 1e-6, math.nan, math.inf, -math.inf])
def test_bad_time_step(dt: float) -> None:
    """dt must be finite and ≥ 1e-5 s; the message has the value and the bound."""
    with pytest.raises(InputError, match=r"dt is .* ≥ 1e-5"):
        Simulator(ball(), dt)


@pytest.mark.parametrize("name", ["q", "v"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x: x[..., :-1], "must end in"),
        (lambda x: torch.zeros((), dtype=torch.float64), "must end in"),
        (lambda x: x.float(), "torch.float32 .* must be torch.float64"),
        (lambda x: x.to("meta"), "on meta: must be torch.float64 on cpu"),
        (lambda x: torch.where(torch.arange(len(x)) == 1, math.nan, x), "NaN or infinity"),
        (lambda x: torch.where(torch.arange(len(x)) == 1, math.inf, x), "NaN or infinity"),
    ],
    ids=["short", "scalar", "float32", "meta device", "NaN", "infinite"],
)
def test_bad_start(name: str, change: Callable[[Tensor], Tensor], words: str) -> None:
    """Wrong shape, dtype, device or values of q or v: `InputError` that names the argument."""
    scene = ball()
    good = {"q": at(0.1), "v": torch.zeros(6, dtype=torch.float64)}
    bad = {**good, name: change(good[name])}
    with pytest.raises(InputError, match=f"^{name} .*{words}"):
        Simulator(scene, 0.01).initial_state(bad["q"], bad["v"])


def test_quaternions_of_a_start_are_normalised() -> None:
    """A quaternion of any norm is a rotation; the state's has unit norm."""
    q = at(0.1, (0.3, 0.2, 0.1))
    q[3:] *= 7.0
    state = Simulator(ball(), 0.01).initial_state(q)
    assert float(torch.linalg.vector_norm(state.q[3:])) == pytest.approx(1.0, abs=1e-15)
    torch.testing.assert_close(state.q, at(0.1, (0.3, 0.2, 0.1)))


def test_bad_controls() -> None:
    """A control must end in nu; controls are [steps, *batch, nu]; steps and controls must not disagree; there must be a step."""
    scene = arm(Actuator.motor("a", "joint"), Actuator.motor("b", "joint"))
    simulator = Simulator(scene, 0.01)
    state = simulator.initial_state()
    assert scene.nu == 2
    with pytest.raises(InputError, match=r"control has shape \(3,\): must end in \(2,\)"):
        simulator.step(state, torch.zeros(3, dtype=torch.float64))
    for shape in ((5, 3), (5,), (0, 2)):
        with pytest.raises(InputError, match=r"controls have shape .*2"):
            simulator.rollout(state, torch.zeros(shape, dtype=torch.float64))
    with pytest.raises(InputError, match="steps is 4 but there are 5 controls"):
        simulator.rollout(state, torch.zeros(5, 2, dtype=torch.float64), steps=4)
    for steps in (None, 0, -1):
        with pytest.raises(InputError, match=f"steps is {steps}"):
            simulator.rollout(state, steps=steps)
    assert simulator.rollout(state, torch.zeros(5, 2, dtype=torch.float64), steps=5).steps == 5


@pytest.mark.parametrize(
    ("gravity", "words"),
    [
        (torch.zeros(2, dtype=torch.float64), "last dimension 3"),
        (torch.zeros((), dtype=torch.float64), "last dimension 3"),
        (torch.tensor([0.0, math.nan, -9.81], dtype=torch.float64), "finite"),
        (torch.tensor([0.0, 0.0, -math.inf], dtype=torch.float64), "finite"),
        (torch.zeros(3), "torch.float32 .* must be torch.float64"),
    ],
    ids=["two numbers", "one number", "NaN", "infinite", "float32"],
)
def test_bad_gravity(gravity: Tensor, words: str) -> None:
    """Gravity is three finite numbers in the articulation's dtype."""
    with pytest.raises(InputError, match=f"gravity is .*{words}"):
        dataclasses.replace(ball(), gravity=gravity)


def test_scene_needs_inertia() -> None:
    """Without `Inertia()` among the terms there is no mechanics to solve."""
    with pytest.raises(InputError, match="Inertia"):
        dataclasses.replace(ball(), terms=())


def test_bad_inertia() -> None:
    """Negative mass and inertias that are not positive semi-definite are refused with the link's name, at `replace` too."""
    articulation = ball().articulation
    for change, words in ((-1.0, "mass is -1.0 kg: must be ≥ 0"), (math.nan, "pseudo_inertia holds NaN")):
        with pytest.raises((ModelError, InputError), match=words):
            dataclasses.replace(articulation, pseudo_inertia=articulation.pseudo_inertia * change)
    lopsided = articulation.pseudo_inertia.clone()
    lopsided[0, 0, 0], lopsided[0, 1, 1] = -0.01, -0.02
    with pytest.raises(ModelError, match="link 'body': inertia is not positive semi-definite"):
        dataclasses.replace(articulation, pseudo_inertia=lopsided)
    with pytest.raises(ModelError, match="link 'body': mass is -1 kg"):
        Articulation.from_links([Link("body", joints=(Joint("f", JointKind.FREE),), mass=-1)])


@pytest.mark.parametrize("name", ["joint_frame", "joint_axis", "joint_ref", "link_frame", "pseudo_inertia", "lower", "upper"])
def test_bad_fields_of_an_articulation(name: str) -> None:
    """Every numeric field must end in its shape, and have the articulation's dtype and no NaN; the message names it."""
    articulation = ball().articulation
    value: Tensor = getattr(articulation, name)
    bad = {
        "must end in": value.new_zeros((*value.shape[:-1], value.shape[-1] + 1)),
        "must be torch.float64": value.float(),
        "holds NaN": torch.full_like(value, math.nan),
    }
    for words, replacement in bad.items():
        change: dict[str, Any] = {name: replacement}
        with pytest.raises(InputError, match=f"^{name} .*{words}"):
            dataclasses.replace(articulation, **change)


@pytest.mark.parametrize(
    ("links", "words"),
    [
        ([], "at least one link"),
        ([Link("a")], "at least one joint"),
        ([Link("a", "nobody")], "link 'a': parent 'nobody' is not among the links before it"),
        ([Link("a", joints=(Joint("j", JointKind.HINGE),)), Link("a")], "link 'a': the name is used twice"),
        ([Link("a", joints=(Joint("j", JointKind.HINGE), Joint("j", JointKind.SLIDE)))], "joint 'j': the name is used twice"),
        ([Link("a", joints=(Joint("j", JointKind.HINGE, axis=(0, 0, 0)),))], r"joint 'j': axis is \(0, 0, 0\): must not be zero"),
        ([Link("a", joints=(Joint("j", JointKind.HINGE, lower=1.0, upper=0.0),))], "lower limit 1.0 is above upper limit 0.0"),
        ([Link("a", joints=(Joint("j", JointKind.HINGE, lower=math.nan),))], "limits are nan"),
        ([Link("a", joints=(Joint("j", JointKind.HINGE, axis=(0, math.nan, 1)),))], "axis, anchor and ref must be finite"),
        ([Link("a", quaternion=(0, 0, 0, 0), joints=(Joint("j", JointKind.HINGE),))], "quaternion is zero"),
        ([Link("a", position=(math.inf, 0, 0), joints=(Joint("j", JointKind.HINGE),))], "must be finite"),
        ([Link("a", joints=(Joint("h", JointKind.HINGE), Joint("j", JointKind.FREE)))], "joint 'j': a free joint must be the only"),
        ([Link("a", joints=(Joint("h", JointKind.HINGE),)), Link("b", "a", joints=(Joint("j", JointKind.FREE),))], "a free joint"),
    ],
    ids=lambda x: None if isinstance(x, list) else x[:40],
)
def test_bad_links(links: list[Link], words: str) -> None:
    """`ModelError` that names the link or joint and what is wrong with it."""
    with pytest.raises(ModelError, match=words):
        Articulation.from_links(links)


def test_impossible_inertia_warns() -> None:
    """Principal moments that break the triangle inequality belong to no body: a warning that names the link."""
    with pytest.warns(UserWarning, match="link 'a'.*triangle inequality"):
        Articulation.from_links([Link("a", joints=(Joint("j", JointKind.HINGE),), mass=1.0, inertia=diagonal(0.1, 0.1, 0.5))])


@pytest.mark.parametrize("kind", [JointKind.HINGE, JointKind.SLIDE, JointKind.BALL])
def test_massless_moving_joint(kind: JointKind) -> None:
    """A joint that moves nothing with inertia cannot be solved for: `ModelError` with its name; armature makes it sound."""
    links = [
        Link("base", joints=(Joint("good", JointKind.HINGE),), mass=1.0, inertia=diagonal(0.1, 0.1, 0.1)),
        Link("tool", "base", joints=(Joint("loose", kind),)),
    ]
    articulation = Articulation.from_links(links)
    with pytest.raises(ModelError, match="joint 'loose': nothing that it moves has any inertia"):
        Scene(articulation, (Inertia(),), down())
    armature = torch.full((articulation.nv,), 0.01, dtype=torch.float64)
    scene = Scene(articulation, (Inertia(), Armature(armature)), down())
    _, solution = Simulator(scene, 0.01).step(Simulator(scene, 0.01).initial_state())
    assert bool(solution.solved)


BAD_PARAMETERS: dict[str, tuple[Callable[[], object], str]] = {
    "stiffness 0": (lambda: NormalForce(0.0), "stiffness is 0.0 .* > 0"),
    "stiffness < 0": (lambda: NormalForce(-1e6), "stiffness is -1000000.0"),
    "stiffness NaN": (lambda: NormalForce(math.nan), "stiffness is nan"),
    "one stiffness of many": (lambda: NormalForce(doubles(1e6, -1.0)), "stiffness is .*-1.0"),
    "exponent 1": (lambda: NormalForce(1e6, 1.0), "exponent α is 1.0: must be > 1"),
    "exponent NaN": (lambda: NormalForce(1e6, math.nan), "exponent α is nan"),
    "weight 0": (lambda: NormalForce.for_weight(0.0), "weight is 0.0"),
    "penetration 0": (lambda: NormalForce.for_weight(1.0, 0.0), "penetration is 0.0 m"),
    "mu < 0": (lambda: CoulombFriction(-0.1), "mu is -0.1"),
    "mu NaN": (lambda: CoulombFriction(doubles(0.1, math.nan)), "mu is .*nan"),
    "slip speed 0": (lambda: CoulombFriction(0.5, 0.0), "slip_speed is 0.0 m/s: must be > 0"),
    "slip speed < 0": (lambda: CoulombFriction(0.5, -1e-3), "slip_speed"),
    "slip speed infinite": (lambda: CoulombFriction(0.5, math.inf), "slip_speed"),
    "C∥ < 0": (lambda: PbfdFriction.as_printed(-1.0), "C∥ is -1.0"),
    "β 0": (lambda: PbfdFriction.as_printed(1.0, beta=0.0), "β is 0.0"),
    "γ < 0": (lambda: PbfdFriction.as_printed(1.0, gamma=-1.0), "γ is -1.0"),
    "β < 1 derived": (lambda: PbfdFriction.as_derived(1.0, beta=0.5), "β is 0.5: the derived law needs β ≥ 1"),
    "normal 0": (lambda: HalfSpace(normal=(0.0, 0.0, 0.0)), "normal of 'ground'"),
    "normal NaN": (lambda: HalfSpace(normal=(0.0, math.nan, 1.0)), "normal of 'ground'"),
    "offset infinite": (lambda: HalfSpace(offset=math.inf), "offset of 'ground'"),
    "sphere radius 0": (lambda: Sphere(0.0), "sphere radius is 0.0"),
    "capsule half length < 0": (lambda: Capsule(0.1, -1.0), "capsule radius, half length"),
    "box extent NaN": (lambda: Box((0.1, math.nan, 0.1)), "box half extents"),
    "cylinder rim": (lambda: Cylinder(0.1, 0.1, rim_points=2), "rim_points is 2: must be ≥ 3"),
    "ellipsoid axis 0": (lambda: Ellipsoid((0.1, 0.0, 0.1)), "ellipsoid semi-axes"),
    "flat hull": (lambda: ConvexHull(np.zeros((3, 3))), "hull vertices"),
    "collider margin < 0": (lambda: Collider("c", "body", Sphere(0.1), margin=-0.1), "margin of collider 'c'"),
    "collider friction < 0": (lambda: Collider("c", "body", Sphere(0.1), friction=-0.1), "friction of collider 'c'"),
    "limit stiffness 0": (lambda: JointLimits(doubles(1.0, 0.0)), "limit stiffness is .*0.0.*> 0"),
    "negative damping": (lambda: JointDamping(doubles(-1.0)), "joint damping is .*-1.0"),
    "negative armature": (lambda: Armature(doubles(-1.0)), "armature is .*-1.0"),
    "negative spring": (lambda: JointSprings(doubles(-1.0), doubles(0.0)), "spring stiffness is .*-1.0"),
    "negative dry friction": (lambda: JointDryFriction(doubles(-1.0)), "dry friction torque is .*-1.0"),
    "dry friction slip speed 0": (lambda: JointDryFriction(doubles(1.0), 0.0), "slip_speed is 0.0"),
    "effort < 0": (lambda: arm(Actuator.motor("m", "joint", effort=-1.0)), "actuator 'm': force_range"),
    "effort NaN": (lambda: arm(Actuator.motor("m", "joint", effort=math.nan)), "actuator 'm': force_range"),
    "violation 0": (lambda: JointLimits.for_articulation(ball().articulation, violation=0.0), "violation is 0.0"),
    "float16": (lambda: ball().articulation.to(torch.float16), "torch.float16: must be torch.float32 or torch.float64"),
    "link name": (lambda: ball().articulation.link_index("hand"), "no link named 'hand': the links are body"),
    "joint name": (lambda: ball().articulation.joint_index("knee"), "no joint named 'knee': the joints are free"),
    "no collider": (
        lambda: Contact.between(ball().articulation, [], HalfSpace(), NormalForce(1.0), None),
        "no collider can touch 'ground'",
    ),
    "collider of no link": (
        lambda: Contact.between(ball().articulation, [Collider("c", "leg", Sphere(0.1))], HalfSpace(), NormalForce(1.0), None),
        "no link named 'leg'",
    ),
    "actuator on a free joint": (
        lambda: Actuators.from_list(ball().articulation, [Actuator.motor("m", "free")]),
        "actuator 'm': joint 'free' must be a hinge or a slide",
    ),
    "actuator on no joint": (lambda: arm(Actuator.motor("m", "wrist")), "no joint named 'wrist'"),
    "actuator stiffness < 0": (lambda: arm(Actuator.position("p", "joint", kp=-1.0)), "actuator 'p': stiffness is -1.0"),
}


@pytest.mark.parametrize("name", BAD_PARAMETERS)
def test_bad_parameters(name: str) -> None:
    """Each is refused where it is given, with the value and what it must be."""
    build, words = BAD_PARAMETERS[name]
    with pytest.raises(InputError, match=words):
        build()


# Records --------------------------------------------------------------------------------------------------------------


@all_batches
@pytest.mark.parametrize("touching", [True, False], ids=["contacts", "no contacts"])
def test_shapes_of_a_rollout(batch: tuple[int, ...], touching: bool) -> None:
    """T steps give T + 1 states and T solves; batch dimensions follow time; without contact terms npoint is 0."""
    setup = chain_ground() if touching else chain_fixed()
    scene = setup.scene
    articulation = scene.articulation
    simulator = Simulator(scene, 0.02)
    q, v = setup.q[0].expand(*batch, -1), setup.v[0].expand(*batch, -1)
    rollout = simulator.rollout(simulator.initial_state(q, v), steps=4)
    points = 20 if touching else 0
    expected = {
        "time": (5,),
        "q": (5, *batch, articulation.nq),
        "v": (5, *batch, articulation.nv),
        "link_poses": (5, *batch, articulation.nlink, 3, 4),
        "center_of_mass": (5, *batch, 3),
        "kinetic_energy": (5, *batch),
        "potential_energy": (5, *batch),
        "linear_momentum": (5, *batch, 3),
        "angular_momentum": (5, *batch, 3),
        "status": (4, *batch),
        "iterations": (4, *batch),
        "evaluations": (4, *batch),
        "residual_norm": (4, *batch),
        "contact_point": (4, *batch, points, 3),
        "contact_depth": (4, *batch, points),
        "contact_force": (4, *batch, points, 3),
    }
    assert {name: tuple(getattr(rollout, name).shape) for name in expected} == expected
    assert rollout.steps == 4
    assert rollout.energy.shape == (5, *batch)
    assert rollout.penetration.shape == (4, *batch)
    assert rollout.solved.shape == (4, *batch)
    assert bool(rollout.solved.all())
    torch.testing.assert_close(rollout.time, 0.02 * torch.arange(5, dtype=torch.float64))
    assert rollout.link_names == articulation.link_names
    assert rollout.joint_names == articulation.joint_names


def test_worlds_with_their_own_gravity_and_mass() -> None:
    """gravity `[*batch, 3]` and pseudo-inertia `[*batch, nlink, 4, 4]`: every world falls and rests as it would alone."""
    gravity = torch.stack([0.2 * down(), down(), 2 * down()])
    scene = ball(CoulombFriction(0.5))
    mass = doubles(1.0, 2.0, 3.0)[:, None, None, None]
    heavier = dataclasses.replace(scene.articulation, pseudo_inertia=mass * scene.articulation.pseudo_inertia)
    many = dataclasses.replace(scene, articulation=heavier, gravity=gravity)
    whole = rolled_out(many, 0.02, 1.2, at(0.06).repeat(3, 1))
    assert bool(whole.solved.all())
    for k in range(3):
        one = dataclasses.replace(scene.articulation, pseudo_inertia=heavier.pseudo_inertia[k])
        alone = rolled_out(dataclasses.replace(scene, articulation=one, gravity=gravity[k]), 0.02, 1.2, at(0.06))
        torch.testing.assert_close(whole.q[:, k], alone.q, rtol=0, atol=1e-8)
        depth = math.sqrt(float(mass[k] * gravity[k].norm()) / 1e6)
        assert float(whole.contact_depth[-1, k]) == pytest.approx(depth, rel=1e-6)


def test_one_start_for_many_worlds() -> None:
    """q `[nq]` with v `[3, nv]` broadcasts to three worlds, and so does the rest configuration."""
    simulator = Simulator(ball(), 0.02)
    v = torch.zeros(3, 6, dtype=torch.float64)
    v[:, 0] = doubles(0.0, 1.0, 2.0)
    rollout = simulator.rollout(simulator.initial_state(at(0.3), v), steps=5)
    torch.testing.assert_close(rollout.q[-1, :, 0], v[:, 0] * 0.1)
    assert simulator.initial_state(v=v).q.shape == (3, 7)
    assert torch.equal(simulator.initial_state().q, ball().articulation.rest)
    worlds = Simulator(dataclasses.replace(ball(), gravity=torch.stack([down(), 2 * down()])), 0.02)
    fallen = worlds.rollout(worlds.initial_state(at(1.0)), steps=5)
    torch.testing.assert_close(fallen.q[-1, :, 2], 1.0 - 0.5 * GRAVITY * 0.01 * doubles(1.0, 2.0), rtol=0, atol=1e-9)
    scene = ball()
    heavier = scene.articulation.pseudo_inertia * torch.ones(4, 1, 1, 1, dtype=torch.float64)
    many = dataclasses.replace(scene, articulation=dataclasses.replace(scene.articulation, pseudo_inertia=heavier))
    assert Simulator(many, 0.02).initial_state().q.shape == (4, 7)


def test_rollout_equals_steps() -> None:
    """`rollout` records what repeated `step` gives, bitwise, and leaves the state that it got alone."""
    setup = chain_slope_drop(2)
    simulator = Simulator(setup.scene, 0.05)
    state = simulator.initial_state(setup.q, setup.v)
    before = state.q.clone()
    rollout = simulator.rollout(state, steps=6)
    assert torch.equal(state.q, before)
    for k in range(6):
        assert torch.equal(rollout.q[k], state.q)
        state, solution = simulator.step(state)
        assert torch.equal(rollout.evaluations[k], solution.evaluations)
    assert torch.equal(rollout.q[-1], state.q)


def test_energy_and_momentum_of_the_record() -> None:
    """The record's energies and momenta are those of a free fall: ½mv² with the step's average velocity, m g z, m v."""
    rollout = rolled_out(ball(), 0.1, 0.5, at(5.0), doubles(1.0, 0, 0, 0, 0, 0))
    velocity = rollout.q[:, :3].diff(dim=0) / 0.1
    torch.testing.assert_close(rollout.kinetic_energy[1:], 0.5 * velocity.square().sum(-1), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(rollout.potential_energy, GRAVITY * rollout.q[:, 2], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(rollout.linear_momentum[1:], velocity, rtol=0, atol=1e-10)
    assert float(rollout.angular_momentum.abs().max()) <= 1e-12
    # entry 0 belongs to the virtual step before the start: v − ½ g Δt
    torch.testing.assert_close(rollout.v[0, :3], doubles(1.0, 0, 0) - 0.05 * down(), rtol=0, atol=1e-10)


# Files ----------------------------------------------------------------------------------------------------------------


@pytest.fixture
def rollout() -> Rollout:
    return rolled_out(ball(CoulombFriction(0.5)), 0.02, 0.1, at(0.06).repeat(2, 1))


ARRAYS = [f.name for f in dataclasses.fields(Rollout) if f.type == "Tensor"]
OVER_TIME = [name for name in ARRAYS if name not in ("lanes", "obstacle_poses")]  # the obstacles stand still


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
def test_saved_rollout_comes_back(tmp_path: Path, dtype: torch.dtype) -> None:
    """save then load: every array bitwise and in its dtype, names and dt equal; folders are made, nothing else is left behind."""
    setup = chain_slope_drop(2, dtype)
    simulator = Simulator(setup.scene, 0.05)
    saved = simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=3)
    path = tmp_path / "new" / "folder" / "run.npz"
    saved.save(path)
    loaded = Rollout.load(path)
    for name in ARRAYS:
        before, after = getattr(saved, name), getattr(loaded, name)
        assert after.dtype == before.dtype, name
        assert torch.equal(after, before), name
    for name in ("scene_name", "dt", "link_names", "joint_names"):
        assert getattr(loaded, name) == getattr(saved, name)
    assert [x.name for x in path.parent.iterdir()] == ["run.npz"]


def test_rollout_without_contacts_comes_back(tmp_path: Path) -> None:
    """Arrays with no contact points survive as well."""
    saved = rolled_out(chain_fixed().scene, 0.02, 0.04)
    saved.save(tmp_path / "run.npz")
    assert Rollout.load(tmp_path / "run.npz").contact_force.shape == saved.contact_force.shape == (2, 0, 3)


def test_saving_replaces_a_file(tmp_path: Path, rollout: Rollout) -> None:
    """An old file at the path is replaced as a whole."""
    path = tmp_path / "run.npz"
    path.write_bytes(b"old")
    rollout.save(path)
    assert torch.equal(Rollout.load(path).q, rollout.q)


def test_bad_paths(tmp_path: Path, rollout: Rollout) -> None:
    """Nothing there, or a folder: `InputError` that names the path, for load and for save."""
    with pytest.raises(InputError, match=r"no rollout at .*missing"):
        Rollout.load(tmp_path / "missing.npz")
    with pytest.raises(InputError, match="not a readable rollout"):
        Rollout.load(tmp_path)
    with pytest.raises(InputError, match="cannot write"):
        rollout.save(tmp_path)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="cannot write"):
        rollout.save(tmp_path / "file" / "run.npz")
    assert sorted(x.name for x in tmp_path.iterdir()) == ["file"]


def test_foreign_files_are_refused(tmp_path: Path, rollout: Rollout) -> None:
    """Pickles (never unpickled), plain arrays, other archives, archives with another `meta`: `InputError` that names the file."""
    rollout.save(tmp_path / "good.npz")
    arrays = dict(np.load(tmp_path / "good.npz"))
    foreign: dict[str, Any] = {
        "empty": lambda p: p.write_bytes(b""),
        "text": lambda p: p.write_text("hello", encoding="utf-8"),
        "pickle": lambda p: p.write_bytes(pickle.dumps(_Explosive())),
        "array": lambda p: _with_file(p, lambda f: np.save(f, np.zeros(3))),
        "other archive": lambda p: np.savez(p, x=np.zeros(3)),
        "pickled meta": lambda p: np.savez(p, **{**arrays, "meta": np.array([_Explosive()], dtype=object)}),
        "pickled array": lambda p: np.savez(p, **{**arrays, "q": np.array([_Explosive()], dtype=object)}),
        "no q": lambda p: np.savez(p, **{k: v for k, v in arrays.items() if k != "q"}),
        "text array": lambda p: np.savez(p, **{**arrays, "q": np.array(["a", "b"])}),
    }
    metas: dict[str, object] = {
        "other format": {"format": "something else"},
        "format only": {"format": FORMAT},
        "names no list": {"format": FORMAT, "scene_name": "s", "dt": 0.1, "link_names": 5, "joint_names": []},
        "dt no number": {"format": FORMAT, "scene_name": "s", "dt": "soon", "link_names": [], "joint_names": []},
        "list": [1, 2],
        "number": 3,
    }
    texts = {"no JSON": "{"} | {name: json.dumps(meta) for name, meta in metas.items()}
    for name, text in texts.items():
        foreign[name] = lambda p, text=text: np.savez(p, **{**arrays, "meta": np.array(text)})
    for name, write in foreign.items():
        path = tmp_path / "foreign.npz"
        write(path)
        with pytest.raises(InputError, match=r"foreign.npz'"):
            Rollout.load(path)
        assert not _Explosive.exploded, name


class _Explosive:
    """Says so when it is unpickled."""

    exploded = False

    def __reduce__(self) -> tuple[Any, ...]:
        return setattr, (_Explosive, "exploded", True)


def _with_file(path: Path, write: Callable[[Any], object]) -> None:
    with path.open("wb") as file:
        write(file)


def test_damaged_files_are_refused(tmp_path: Path, rollout: Rollout) -> None:
    """A file cut short anywhere, or with bytes changed: `InputError`, or the same data (the change hit nothing that matters)."""
    path = tmp_path / "run.npz"
    rollout.save(path)
    data = path.read_bytes()
    random = np.random.default_rng(0)
    refused = 0
    for k in range(300):
        damaged = bytearray(data)
        if k % 3 == 0:
            damaged = damaged[: int(random.integers(len(data)))]
        else:
            for _ in range(1 if k % 3 == 1 else 20):
                damaged[int(random.integers(len(data)))] = int(random.integers(256))
        path.write_bytes(bytes(damaged))
        try:
            assert torch.equal(Rollout.load(path).q, rollout.q)
        except InputError:
            refused += 1
    assert refused > 200


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_interrupted_save_leaves_nothing(
    tmp_path: Path, rollout: Rollout, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    """An interruption or a full disk half-way: the old file stays, no partial one is left."""
    path = tmp_path / "run.npz"
    rollout.save(path)
    good = path.read_bytes()

    def half(file: Any, **arrays: Any) -> None:
        Path(file).write_bytes(b"half a file")
        raise error

    monkeypatch.setattr(np, "savez_compressed", half)
    with pytest.raises((KeyboardInterrupt, InputError)):
        rollout.save(path)
    assert path.read_bytes() == good
    assert [x.name for x in tmp_path.iterdir()] == ["run.npz"]


# Progress and interruption --------------------------------------------------------------------------------------------


def test_progress_is_called_after_every_step() -> None:
    """With 1, 2, …, T."""
    seen: list[int] = []
    simulator = Simulator(ball(), 0.02)
    simulator.rollout(simulator.initial_state(at(0.3)), steps=5, progress=seen.append)
    assert seen == [1, 2, 3, 4, 5]


def test_interrupted_rollout_keeps_what_it_has() -> None:
    """KeyboardInterrupt in `progress` after step 3: a rollout of 3 steps, bitwise the beginning of the whole one; any other error
    comes through."""
    simulator = Simulator(ball(), 0.02)
    state = simulator.initial_state(at(0.06))
    whole = simulator.rollout(state, steps=6)

    def stop(step: int) -> None:
        if step == 3:
            raise KeyboardInterrupt

    part = simulator.rollout(state, steps=6, progress=stop)
    assert part.steps == 3
    assert all(len(getattr(part, name)) == len(getattr(whole, name)) - 3 for name in OVER_TIME)
    assert torch.equal(part.q, whole.q[:4])

    def fail(step: int) -> None:
        raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        simulator.rollout(state, steps=6, progress=fail)


@pytest.mark.parametrize("call", [1, 3])
def test_interruption_inside_a_step(monkeypatch: pytest.MonkeyPatch, call: int) -> None:
    """KeyboardInterrupt while a step is recorded: the steps before it are kept, whole; where there are none it comes through."""
    simulator = Simulator(ball(), 0.02)
    state = simulator.initial_state(at(0.06))
    points, calls = Contact.points, [0]

    def interrupted(self: Contact, *arguments: Any) -> Any:
        calls[0] += 1
        if calls[0] == call:
            raise KeyboardInterrupt
        return points(self, *arguments)

    monkeypatch.setattr(Contact, "points", interrupted)
    if call == 1:
        with pytest.raises(KeyboardInterrupt):
            simulator.rollout(state, steps=6)
        return
    part = simulator.rollout(state, steps=6)
    assert part.steps == 2
    lengths = {name: len(getattr(part, name)) for name in OVER_TIME}
    assert set(lengths.values()) == {2, 3}
    assert lengths["q"] == lengths["time"] == 3
    assert lengths["status"] == lengths["contact_force"] == 2


# Actuators in motion --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_motor(dt: float) -> None:
    """x = ½ (F/m) t² exactly at the grid points, F = gear · min(u, effort)."""
    scene = arm(Actuator.motor("m", "joint", gear=2.0, effort=1.5))
    simulator = Simulator(scene, dt)
    for control, force in ((1.0, 2.0), (7.0, 3.0), (-7.0, -3.0)):
        u = doubles(control)
        rollout = simulator.rollout(simulator.initial_state(control=u), u.expand(20, 1))
        exact = 0.5 * force / 2.0 * rollout.time**2
        assert float((rollout.q[:, 0] - exact).abs().max()) <= 1e-9


@pytest.mark.parametrize("dt", [0.01, 0.1])
def test_position_servo_sags(dt: float) -> None:
    """Under a load F a position servo ends at u + F/kp, at rest; beyond its effort it gives way with (F − effort)/m."""
    load = doubles(3.0, 0.0, 0.0)  # m g_x = 6 N
    simulator = Simulator(arm(Actuator.position("p", "joint", kp=200.0, kv=40.0), gravity=load), dt)
    rollout = simulator.rollout(simulator.initial_state(), doubles(0.5).expand(round(6.0 / dt), 1))
    assert float(rollout.q[-1, 0]) == pytest.approx(0.5 + 6.0 / 200.0, abs=1e-8)
    assert float(rollout.v[-1].abs()) <= 1e-8
    weak = implicit(arm(Actuator.position("p", "joint", kp=200.0, kv=40.0, effort=2.0), gravity=load), dt)
    rollout = weak.rollout(weak.initial_state(doubles(1.0)), doubles(0.0).expand(20, 1))
    acceleration = rollout.v[1:, 0].diff() / dt
    assert float((acceleration - (6.0 - 2.0) / 2.0).abs().max()) <= 1e-6


@pytest.mark.parametrize("dt", [0.01, 0.1])
def test_velocity_servo_lags(dt: float) -> None:
    """Under a load F a velocity servo runs at u + F/kv, which it nears by v_{n+1} = (v_n + Δt (kv u + F)/m)/(1 + Δt kv/m)."""
    mass, kv, u = 2.0, 15.0, 0.8
    simulator = implicit(arm(Actuator.velocity("v", "joint", kv=kv), gravity=doubles(3.0, 0.0, 0.0)), dt)
    rollout = simulator.rollout(simulator.initial_state(), doubles(u).expand(round(4.0 / dt), 1))
    v = rollout.v[:, 0]
    expected = (v[:-1] + dt * (kv * u + 6.0) / mass) / (1 + dt * kv / mass)
    assert float((v[1:] - expected).abs().max()) <= 1e-7
    assert float(v[-1]) == pytest.approx(u + 6.0 / kv, abs=1e-7)


def test_stiff_servo_is_stable() -> None:
    """kp = 1e7 at Δt .1: the joint is where it is told after one step, without ringing."""
    simulator = Simulator(arm(Actuator.position("p", "joint", kp=1e7)), 0.1)
    rollout = simulator.rollout(simulator.initial_state(), doubles(0.3).expand(20, 1))
    assert bool(rollout.solved.all())
    assert float((rollout.q[1:, 0] - 0.3).abs().max()) <= 0.3 * 2.0 / 0.1**2 / 1e7 * 2


@all_batches
def test_controls_of_every_world(batch: tuple[int, ...]) -> None:
    """controls `[steps, *batch, nu]`: each world moves as its own control says; a control without batch goes to all."""
    simulator = Simulator(arm(Actuator.motor("a", "joint"), Actuator.motor("b", "joint")), 0.05)
    start = torch.zeros(*batch, 1, dtype=torch.float64)
    count = math.prod(batch)
    control = torch.arange(1.0, 2 * count + 1, dtype=torch.float64).view(*batch, 2)
    state = simulator.initial_state(start, control=control)
    rollout = simulator.rollout(state, control.expand(10, *batch, 2))
    expected = 0.5 * control.sum(-1) / 2.0 * 0.5**2
    torch.testing.assert_close(rollout.q[-1, ..., 0], expected, rtol=1e-9, atol=1e-9)
    shared = simulator.rollout(simulator.initial_state(start), torch.ones(10, 2, dtype=torch.float64))
    assert shared.q.shape == (11, *batch, 1)


# Single precision -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.02, 0.05])
def test_single_precision(dt: float) -> None:
    """float32 solves every step of the chain's fall onto the slope at its own tolerance, .6 s: penetration < 1 mm, energy never
    rises by more than its rounding. At Δt .02 its centre of mass is within a millimetre of float64's; at Δt .05 the impact has
    several solutions, and the two may take different ones."""
    single, double = chain_slope_drop(1, torch.float32), chain_slope_drop()
    rough = rolled_out(single.scene, dt, 0.6, single.q, single.v)
    assert rough.q.dtype == rough.energy.dtype == rough.contact_force.dtype == torch.float32
    assert bool(rough.solved.all())
    assert 0 < float(rough.penetration.max()) < 1e-3
    assert rises(rough.energy) <= 1e-5
    if dt == 0.02:
        exact = rolled_out(double.scene, dt, 0.6, double.q, double.v)
        assert float((rough.center_of_mass - exact.center_of_mass).abs().max()) <= 1e-3


def test_friction_of_the_wrong_length() -> None:
    """A μ per candidate must fit the number of candidates: the message says how many there are."""
    scene = chain_ground().scene
    (contact,) = [term for term in scene.terms if isinstance(term, Contact)]
    with pytest.raises(InputError, match=r"20 candidates"):
        dataclasses.replace(contact, friction=CoulombFriction(torch.full((7,), 0.5, dtype=torch.float64)))
