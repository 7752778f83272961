"""Bodies that rest on and fall onto each other: stacks, mass ratios, overhangs, an arch."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.shapes import Box, Capsule, Sphere
from pbfd_torch.models.setup import Setup
from pbfd_torch.models.stacks import HALF, arch, heavy_on_light, stack, stack_10
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.rotations import quaternion_exp
from tests.bodies import GRAVITY, rises, rolled_out
from tests.touching_bodies import SLIP_SPEED, STIFFNESS, free_bodies, posed, stored


def sunk(mass: float, points: int = 4) -> float:
    """How deep `points` points rest under a mass [m]."""
    return math.sqrt(mass * GRAVITY / points / STIFFNESS)


def sound(rollout: Rollout) -> None:
    """Every step is solved, and nothing is suspected."""
    assert bool(rollout.solved.all())
    assert not bool(rollout.hazards.any())


def moves(rollout: Rollout, since: float) -> Tensor:
    """How far each link is at most from where it was at a time [s], after it, `[*batch, nlink]`."""
    place = rollout.link_poses[round(since / rollout.dt) :, ..., 3]
    return torch.linalg.vector_norm(place - place[:1], dim=-1).amax(0)


# Stacks ---------------------------------------------------------------------------------------------------------------

STACKS: list[tuple[Callable[[], Setup], float, float, float]] = [
    (stack, 0.1, 10.0, 5.0),
    (stack, 0.05, 10.0, 3.0),
    (stack, 0.01, 1.0, 1.0),
    (stack_10, 0.05, 10.0, 3.0),
]


@pytest.mark.parametrize(("scene", "dt", "settled", "_"), STACKS)
def test_settled_stack_stays(scene: Callable[[], Setup], dt: float, settled: float, _: float) -> None:
    """Five and ten boxes of 1 kg that start at rest: no box moves by a micrometre."""
    setup = scene()
    rollout = rolled_out(setup.scene, dt, settled, setup.q)
    sound(rollout)
    assert float(moves(rollout, 0.0).max()) <= 1e-6


@pytest.mark.parametrize(("scene", "dt", "_", "loose"), STACKS)
def test_loose_stack_settles(scene: Callable[[], Setup], dt: float, _: float, loose: float) -> None:
    """Two stacks that start with gaps of 1 mm, boxes up to 1 cm aside and turned by up to 3.4°: each falls together in half a
    second; no box moves by a millimetre after that, nor faster than friction lets it creep; and the ground bears all weight."""
    setup = scene()
    random = torch.Generator().manual_seed(0)
    boxes = setup.q.reshape(1, -1, 7).repeat(2, 1, 1)
    count = boxes.shape[1]
    aside, turn = (2 * torch.rand(2, count, n, generator=random, dtype=torch.float64) - 1 for n in (2, 1))
    boxes[..., :2] += 0.01 * aside
    boxes[..., 2] += 1e-3 * torch.arange(1, count + 1)
    boxes[..., 3:] = quaternion_exp(torch.nn.functional.pad(0.06 * turn, (2, 0)))
    rollout = rolled_out(setup.scene, dt, loose, boxes.flatten(-2))
    sound(rollout)
    assert float((rollout.link_poses[-1, :, -1, 2, 3] - (boxes[:, -1, 2] - 1e-3 * count)).abs().max()) < 1e-3
    assert float(moves(rollout, 0.5).max()) < 1e-3
    assert float(rollout.v[-1].abs().max()) <= 0.1 * SLIP_SPEED
    ground = rollout.contact_force[-1, :, : 8 * count, 2].sum(-1)
    torch.testing.assert_close(ground, torch.full_like(ground, count * GRAVITY), rtol=1e-4, atol=0)


# Mass ratios ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.01, 0.05, 0.1])
def test_heavy_sphere_on_a_light_one(dt: float) -> None:
    """100 kg on 1 kg on the ground, upright by symmetry, from a gap of a millimetre: the ground bears 101 g and the pair 100 g, to
    1e-6, and the lower one's contacts are √(N/C⊥) deep."""
    scene = free_bodies([Sphere(0.1), Sphere(0.1)], [1.0, 100.0])
    rollout = rolled_out(scene, dt, 1.5, posed((0.0, 0.0, 0.101), (0.0, 0.0, 0.302)))
    sound(rollout)
    force, depth = rollout.contact_force[-1, 0, :, 2], rollout.contact_depth[-1, 0]
    borne = force[force.abs() > 0].abs()
    assert borne.tolist() == pytest.approx([101 * GRAVITY, 100 * GRAVITY], rel=1e-6)
    assert depth[depth > 0].tolist() == pytest.approx([sunk(101.0, 1), sunk(100.0, 1)], rel=1e-6)


@pytest.mark.parametrize(("dt", "duration", "gap"), [(0.01, 1.0, 0.0), (0.1, 10.0, 0.0), (0.05, 3.0, 1e-3), (0.1, 10.0, 1e-3)])
def test_heavy_cube_on_a_light_one(dt: float, duration: float, gap: float) -> None:
    """A ton on a kilogram: at rest nothing moves by a micrometre; let fall by a millimetre, and by a centimetre off the middle, it
    comes to rest on it within 1 s and stays within a millimetre."""
    setup = heavy_on_light()
    q = setup.q + gap * torch.tensor([0, 0, 1, 0, 0, 0, 0, 10, 0, 2, 0, 0, 0, 0], dtype=torch.float64)
    rollout = rolled_out(setup.scene, dt, duration, q)
    sound(rollout)
    assert float(moves(rollout, 1.0 if gap else 0.0).max()) < (1e-3 if gap else 1e-6)
    assert float(rollout.link_poses[-1, 0, 1, 2, 3]) == pytest.approx(float(setup.q[0, 9]), abs=1e-4)


# Supports -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_overhang(dt: float) -> None:
    """A box on a box of .1 m half length, put aside: with its centre over the lower one, to 95 % of that, it stays to .2 mm;
    beyond, from 105 % on, it tips and ends on the ground, leaning or lying."""
    scene = free_bodies([Box(HALF)] * 2, [1.0, 1.0])
    aside = torch.tensor([0.05, 0.095, 0.105, 0.15], dtype=torch.float64)
    q = posed((0.0, 0.0, HALF[2] - sunk(1.0)), (0.0, 0.0, 3 * HALF[2] - sunk(1.0))).repeat(len(aside), 1)
    q[:, 7] = aside
    rollout = rolled_out(scene, dt, 1.0, q)
    sound(rollout)
    upper = rollout.link_poses[-1, :, 1]
    assert float((upper[:2, 0, 3] - aside[:2]).abs().max()) <= 2e-4
    assert float(upper[:2, 2, 2].min()) >= 1 - 1e-5
    assert float(upper[2:, 2, 3].max()) <= 0.11
    assert float((upper[2:, 0, 3] - aside[2:]).min()) > 0.01


@pytest.mark.parametrize("dt", [0.01, 0.05, 0.1])
def test_bridge(dt: float) -> None:
    """A box over two, let fall by a millimetre, two centimetres off the middle of supports .3 m apart (the inner edges .2 m, the
    outer ends .4 m): it stays, and the moments of its supports' forces about its centre balance, to 1e-6."""
    pillar = Box((0.05, 0.1, 0.05))
    scene = free_bodies([pillar, pillar, Box((0.2, 0.1, 0.05))], [1.0] * 3)
    rollout = rolled_out(scene, dt, 1.5, posed((-0.15, 0.0, 0.05), (0.15, 0.0, 0.05), (0.02, 0.0, 0.151)))
    sound(rollout)
    assert float(moves(rollout, 1.0).max()) <= 1e-6
    force, point = rollout.contact_force[-1, 0, 24:], rollout.contact_point[-1, 0, 24:]
    moment = torch.linalg.cross(point - rollout.link_poses[-1, 0, 2, :, 3], force).sum(0)
    assert float(force[:, 2].sum().abs()) == pytest.approx(GRAVITY, rel=1e-6)
    assert float(moment.abs().max()) <= 1e-6 * 0.2 * GRAVITY


@pytest.mark.parametrize("dt", [0.02, 0.05])
def test_capsule_in_a_valley(dt: float) -> None:
    """A capsule lies on two parallel ones, which nothing but friction (μ = 1) keeps together: it stays, midway."""
    lying = (math.pi / 2, 0.0, 0.0)
    scene = free_bodies([Capsule(0.05, 0.2)] * 3, [1.0] * 3, mu=1.0)
    top = 0.05 + math.sqrt(0.1**2 - 0.051**2)
    q = posed((-0.051, 0.0, 0.05, *lying), (0.051, 0.0, 0.05, *lying), (0.0, 0.0, top, *lying))
    rollout = rolled_out(scene, dt, 1.0, q)
    sound(rollout)
    left, right, upper = rollout.link_poses[-1, 0, :, :, 3]
    assert float(moves(rollout, 0.5).max()) <= SLIP_SPEED
    assert float(upper[2]) == pytest.approx(top, abs=1e-3)
    assert float(left[0] + right[0]) == pytest.approx(0.0, abs=1e-6)
    assert float(upper[0]) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("dt", [0.01, 0.05, 0.1])
def test_boxes_pushed_together(dt: float) -> None:
    """1 kg at 1 m/s against 3 kg at −1 m/s, without friction: inelastic, both go on at −½ m/s side by side, but for 3 % of 2 m/s
    that the contact gives back; momentum is kept to 1e-9, and energy never rises."""
    scene = free_bodies([Box(HALF)] * 2, [1.0, 3.0], mu=0.0)
    q = posed((-0.15, 0.0, HALF[2] - sunk(1.0)), (0.15, 0.0, HALF[2] - sunk(3.0)))
    v = torch.zeros(12, dtype=torch.float64)
    v[0], v[6] = 1.0, -1.0
    rollout = rolled_out(scene, dt, 0.5, q, v[None])
    sound(rollout)
    assert float((rollout.linear_momentum[..., 0] + 2.0).abs().max()) <= 1e-9
    assert 0 <= float(rollout.v[-1, 0, 6] - rollout.v[-1, 0, 0]) <= 0.03 * 2.0
    assert float((rollout.q[:, 0, 7] - rollout.q[:, 0, 0]).min()) >= 2 * HALF[0] - 1e-3
    assert rises(rollout.energy[1:] + stored(rollout, 16)) <= 1e-9


# The arch -------------------------------------------------------------------------------------------------------------


def gripping(setup: Setup, law: FrictionLaw) -> Scene:
    """The set-up's bodies with another friction law for μ = 1."""
    scene = setup.scene
    rules = ContactRules(NormalForce(1e9), law, slots=16 * scene.articulation.nlink)
    terms = contact_terms(scene.articulation, scene.colliders, scene.obstacles, rules)
    return dataclasses.replace(scene, terms=(Inertia(), *terms))


def test_arch_creeps_without_anchors() -> None:
    """Eleven stones under compression, μ = .7: they settle by millimetres in the first second, and then creep steadily, no faster
    than ε_v."""
    setup = arch()
    rollout = rolled_out(gripping(setup, CoulombFriction(1.0, SLIP_SPEED)), 0.05, 5.0, setup.q)
    sound(rollout)
    speed = torch.linalg.vector_norm(rollout.link_poses[..., 3].diff(dim=0), dim=-1)[20:] / 0.05
    assert float(moves(rollout, 0.0).max()) < 6e-3
    assert float(speed.max()) < SLIP_SPEED
    assert float((speed[-1] - speed[len(speed) // 2]).abs().max()) <= 0.01 * float(speed.max())


def test_arch_stands() -> None:
    """With anchors it stands: after the first second nothing moves by a micrometre."""
    setup = arch()
    rollout = rolled_out(setup.scene, 0.05, 5.0, setup.q)
    sound(rollout)
    assert float(moves(rollout, 0.0).max()) < 6e-3
    assert float(moves(rollout, 1.0).max()) <= 1e-6


# Impact ---------------------------------------------------------------------------------------------------------------

TILTS = [(0.0, 0.0, 0.0), (0.3, 0.2, 0.0), (0.7, 0.5, 0.1)]


@pytest.mark.parametrize("dt", [0.01, 0.02, 0.05, 0.1])
def test_drop_onto_a_box(dt: float) -> None:
    """Flat and tilted from .5 m onto a larger free box: the centre never rises again by more than 1 % of that, the box ends flat on
    the other one, √(mg/4C⊥) deep, and energy is never above that of the start. Nor does it rise, but for what implicit Euler adds
    where a body tips over a corner: its height there is concave, −½ λ φ² with λ = m g l/(I + m l²) ≤ ½ g √(m/I), which gives at
    most λ Δt² of the kinetic energy in a step."""
    lower, upper = (0.3, 0.3, 0.05), (0.1, 0.1, 0.05)
    scene = free_bodies([Box(lower), Box(upper)], [9.0, 1.0])
    top = 0.1 - sunk(9.0)
    q = torch.cat([posed((0.0, 0.0, 0.05 - sunk(9.0)), (0.01, 0.02, top + 0.05 + 0.5, *tilt)) for tilt in TILTS])
    rollout = rolled_out(scene, dt, 1.2, q)
    sound(rollout)
    place = rollout.link_poses[:, :, 1, :, 3]
    height = place[..., 2]
    assert float((height - height.cummin(0).values).max()) <= 0.01 * 0.5
    assert float(rollout.v[-1].abs().max()) <= 1e-3
    expected = 0.05 - sunk(10.0) + 0.05 + 0.05 - sunk(1.0)
    torch.testing.assert_close(height[-1], torch.full_like(height[-1], expected), rtol=0, atol=1e-4)
    energy = rollout.energy[1:] + stored(rollout, 16)
    assert float((energy - rollout.energy[0]).max()) <= 1e-9
    tipping = 0.5 * GRAVITY * math.sqrt(3 / (0.1**2 + 0.05**2)) * dt**2
    assert float((energy.diff(dim=0) - tipping * rollout.kinetic_energy[2:]).max()) <= 1e-9
