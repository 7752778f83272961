"""Bad input of scenes, articulations, terms and simulators: refused by name, with the value and what it must be."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch import Articulation, InputError, Joint, JointKind, Link, ModelError, Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Capsule, Collider, ConvexHull, Ellipsoid, Sphere
from pbfd_torch.models.chains import chain_ground
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from tests.bodies import at, diagonal, down
from tests.small_scenes import arm, ball, doubles


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


def test_friction_of_the_wrong_length() -> None:
    """A μ per candidate must fit the number of candidates: the message says how many there are."""
    scene = chain_ground().scene
    (contact,) = [term for term in scene.terms if isinstance(term, Contact)]
    with pytest.raises(InputError, match=r"20 candidates"):
        dataclasses.replace(contact, friction=CoulombFriction(torch.full((7,), 0.5, dtype=torch.float64)))
