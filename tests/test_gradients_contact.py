"""Derivatives through contact with solids of every kind, still and moving, and between bodies."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
import trimesh

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.height_field import HeightField
from pbfd_torch.contact.mesh_distance import Mesh
from pbfd_torch.contact.motion import Conveyor, Lift, Turntable
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Capsule, ConvexHull, Cylinder, Ellipsoid, Shape, Sphere
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.normal_force import NormalForce
from tests.gradient_checks import SMOOTH, Experiment, compared
from tests.random_trees import generator
from tests.test_obstacle_physics import TOPS, on
from tests.touching_bodies import Pose, free_bodies, posed

SOFT = NormalForce(1e6)
SLIDING = CoulombFriction(0.4, slip_speed=1e-2)
CURVED = (Cylinder(0.1, 0.05), Ellipsoid((0.1, 0.12, 0.08)))
MOVING = {
    "turntable": HalfSpace(motion=Turntable(1.5, (0.2, 0.1, 1.0), (0.5, 0.1, 0.0))),
    "lift": HalfSpace(motion=Lift(lambda time: 0.1 * torch.sin(3 * time))),
    "conveyor": HalfSpace(motion=Conveyor((0.4, 0.1, 0.0))),
}


def wrong(experiment: Experiment, largest: float = 3e-3) -> dict[str, tuple[float, float]]:
    """The derivatives that are off by more than 1e-7, relative, with their differences."""
    found = compared(experiment, largest=largest)
    return {n: (f.implicit, f.differences) for n, f in found.items() if not (f.same and f.error <= 1e-7)}


def thrown(obstacle: Obstacle | HalfSpace, shape: Shape, friction: CoulombFriction | AnchoredFriction = SLIDING) -> Experiment:
    """A body that sinks into the top of an obstacle as it slides and turns."""
    scene = on(obstacle, shape, friction, SOFT)
    depth = {Sphere: 0.1, Box: 0.05, Capsule: 0.1, Cylinder: 0.055, Ellipsoid: 0.08}[type(shape)]
    q = posed((0.02, 0.01, depth - 2e-3, 0.05, 0.02, 0.1))[0]
    v = torch.tensor([0.5, 0.2, -0.1, 0.3, -0.2, 0.4], dtype=torch.float64)
    return Experiment(scene, 0.01, SMOOTH["energy-momentum"], q, v)


@pytest.mark.parametrize("solid", TOPS)
@pytest.mark.parametrize("shape", [Sphere(0.1), Box((0.1, 0.1, 0.05))], ids=["sphere", "box"])
def test_obstacles(solid: str, shape: Shape) -> None:
    """By the state, the numbers of the body and the contact, and where the obstacle stands: ≤ 1e-7 of central differences."""
    assert not wrong(thrown(TOPS[solid], shape))


@pytest.mark.parametrize("motion", MOVING)
def test_moving_ground(motion: str) -> None:
    """A box that sticks and slides on ground that turns, rises or runs: ≤ 1e-7 of central differences."""
    assert not wrong(thrown(MOVING[motion], Box((0.1, 0.1, 0.05))))


def terrain() -> Obstacle:
    """Wavy ground."""
    field = HeightField.from_function(lambda x, y: 0.03 * np.sin(3 * x) * np.cos(2 * y), (2.0, 2.0), 0.1)
    return Obstacle("terrain", field)


def cube() -> Obstacle:
    """A cube whose distance is a spline; its top is at z = 0."""
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    return Obstacle("cube", Mesh(np.asarray(box.vertices), np.asarray(box.faces), cell=0.1, margin=0.5), (0.0, 0.0, -0.5))


@pytest.mark.parametrize("shape", [Sphere(0.1), *CURVED], ids=lambda x: type(x).__name__)
def test_height_field(shape: Shape) -> None:
    """A round body on a wavy terrain."""
    assert not wrong(thrown(terrain(), shape), largest=3e-4)


@pytest.mark.parametrize("shape", [Sphere(0.1), *CURVED], ids=lambda x: type(x).__name__)
def test_mesh(shape: Shape) -> None:
    """A round body that presses into the middle of a cube's top."""
    assert not wrong(thrown(cube(), shape), largest=3e-4)


@pytest.mark.parametrize("shape", CURVED, ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("ground", ["still", *MOVING])
def test_curved_bodies(ground: str, shape: Shape) -> None:
    """An ellipsoid, and a cylinder that stands between flat and tilted, on the still and the moving ground."""
    assert not wrong(thrown(MOVING.get(ground, HalfSpace()), shape), largest=1e-3)


def test_a_flat_rim_has_derivatives() -> None:
    """A cylinder that lies flat to the bit, where its lowest point is not determined."""
    experiment = thrown(HalfSpace(), Cylinder(0.1, 0.05))
    flat = dataclasses.replace(experiment, q=posed((0.0, 0.0, 0.048))[0], v=torch.tensor([0.5, 0.2, -0.1, 0.0, 0.0, 0.4]).double())
    assert not wrong(flat, largest=1e-3)


@pytest.mark.parametrize("stretch", [1e-2, 1e-4], ids=["stuck", "dragged"])
def test_anchors(stretch: float) -> None:
    """What anchors remember is followed from step to step."""
    assert not wrong(thrown(TOPS["box"], Box((0.1, 0.1, 0.05)), AnchoredFriction(0.4, stretch)))


BOTH = ("q", "v", "dt", "gravity", "articulation.pseudo_inertia")
MEETINGS: dict[str, tuple[tuple[Shape, ...], tuple[Pose, ...]]] = {
    "sphere on sphere": ((Sphere(0.1), Sphere(0.1)), ((0, 0, 0.0999), (0.02, 0.01, 0.2974))),
    "sphere on box": ((Box((0.1, 0.1, 0.05)), Sphere(0.1)), ((0, 0, 0.0498, 0.01, 0, 0), (0.02, 0.01, 0.1996))),
    "box on box": ((Box((0.1, 0.1, 0.05)), Box((0.08, 0.07, 0.05))), ((0, 0, 0.0498), (0.01, 0.01, 0.1495, 0.003, 0.002, 0.3))),
    "edge on box": ((Box((0.1, 0.1, 0.05)), Box((0.08, 0.07, 0.05))), ((0, 0, 0.0498), (0.01, 0.01, 0.17, 0.3, 0.2, 0.3))),
    "ellipsoid on box": (
        (Box((0.1, 0.1, 0.05)), Ellipsoid((0.1, 0.08, 0.06))),
        ((0, 0, 0.0498), (0.01, 0.01, 0.1595, 0.03, 0.02, 0.3)),
    ),
    "rim on box": ((Box((0.1, 0.1, 0.05)), Cylinder(0.06, 0.03)), ((0, 0, 0.0498), (0.01, 0.01, 0.1598, 1.4, 0.2, 0.3))),
    "cap on box": ((Box((0.1, 0.1, 0.05)), Cylinder(0.06, 0.03)), ((0, 0, 0.0498), (0.01, 0.01, 0.1295, 0.003, 0.002, 0.3))),
    "capsules": ((Capsule(0.05, 0.1), Capsule(0.05, 0.1)), ((0, 0, 0.0499, 0, 1.5, 0), (0.02, 0.01, 0.1496, 1.5, 0, 0))),
    "ellipsoids": (
        (Ellipsoid((0.1, 0.12, 0.08)), Ellipsoid((0.07, 0.08, 0.1))),
        ((0, 0, 0.0798), (0.02, 0.01, 0.2525, 0.3, 0.2, 0.3)),
    ),
    "ellipsoid on capsule": (
        (Capsule(0.05, 0.1), Ellipsoid((0.07, 0.08, 0.1))),
        ((0, 0, 0.0499, 0, 1.5, 0), (0.02, 0.01, 0.1895, 0.3, 0.2, 0.3)),
    ),
    "crossed cylinders": (
        (Cylinder(0.06, 0.1), Cylinder(0.05, 0.1)),
        ((0, 0, 0.0598, 0, 1.5, 0), (0.02, 0.01, 0.1685, 1.5, 0, 0)),
    ),
    "sphere on cylinder": ((Cylinder(0.06, 0.1), Sphere(0.1)), ((0, 0, 0.0598, 0, 1.5, 0), (0.02, 0.01, 0.219))),
    "hull on box": (
        (Box((0.1, 0.1, 0.05)), ConvexHull(0.1 * torch.randn(9, 3, dtype=torch.float64, generator=generator(3)).numpy())),
        ((0, 0, 0.0498), (0.01, 0.01, 0.2, 0.3, 0.2, 0.3)),
    ),
}


@pytest.mark.parametrize("name", MEETINGS)
@pytest.mark.parametrize("integrator", ["implicit-euler", "energy-momentum"])
def test_bodies_that_meet(name: str, integrator: str) -> None:
    """Two free bodies on the ground and on each other; the points and planes of the contact follow the bodies' poses at the start
    of each step. All contacts soft, so that differences see little of their rounding: ≤ 1e-6, and 1e-5 where FCL finds the
    direction of contact, to less than full precision."""
    shapes, poses = MEETINGS[name]
    v = torch.tensor([0.0] * 6 + [0.1, 0.05, -0.3, 0.2, 0.1, 0.3], dtype=torch.float64)
    scene = free_bodies(shapes, [1.0, 0.7])
    soft = {x: torch.tensor(1e6, dtype=torch.float64) for x in parameters(scene) if x.endswith("force.stiffness")}
    experiment = Experiment(with_parameters(scene, soft), 0.01, SMOOTH[integrator], posed(*poses)[0], v)
    found = compared(
        experiment, largest=2e-3, names=tuple(x for x in experiment.values if x in BOTH or x.endswith((".mu", "force.stiffness")))
    )
    most = 1e-5 if any(x in name for x in ("hull", "ellipsoid on box", "rim", "cap on")) else 1e-6
    assert not {n: (f.implicit, f.differences) for n, f in found.items() if not (f.same and f.error <= most)}
