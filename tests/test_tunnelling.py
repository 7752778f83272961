"""Fast bodies and thin solids: nothing convex is jumped."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.hazards import Hazard
from pbfd_torch.contact.height_field import HeightField
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.polytope import thickness_of
from pbfd_torch.contact.primitives import BoxSurface, SegmentSurface, SphereSurface
from pbfd_torch.contact.shapes import Box, Capsule, Collider, ConvexHull, Cylinder, Shape, Sphere
from pbfd_torch.contact.surface import Surface, Tangent
from pbfd_torch.models.stacks import solid_box
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.terms.contact_terms import contact_terms
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.articulation import Articulation
from tests.bodies import rolled_out
from tests.finite_differences import derivative, relative_error
from tests.random_trees import generator

PLATE = (1.0, 1.0, 0.005)  # half extents [m]: 1 cm thick
SHEET = ConvexHull(np.array([[x, y, 0.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)]))


@pytest.mark.parametrize(("speed", "dt"), [(20.0, 0.02), (20.0, 0.1), (100.0, 0.1)])
@pytest.mark.parametrize("shape", [Sphere(0.05), Box((0.05, 0.05, 0.05)), Capsule(0.02, 0.05)], ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("plate", ["obstacle", "link"])
def test_a_plate_stops_what_would_jump_it(plate: str, shape: Shape, speed: float, dt: float) -> None:
    """A body that covers .4 to 10 m in a step ends on its own side of a plate of 1 cm, a fixed one or one of 1000 kg that floats;
    every step is solved, and nothing was missed."""
    links, colliders = [solid_box("body", (0.05, 0.05, 0.05), 1.0)], [Collider("body", "body", shape)]
    obstacles = [Obstacle("plate", Box(PLATE))] if plate == "obstacle" else []
    if plate == "link":
        links.append(solid_box("plate", PLATE, 1000.0))
        colliders.append(Collider("plate", "plate", Box(PLATE)))
    articulation = Articulation.from_links(links)
    still = torch.zeros(3, dtype=torch.float64)
    scene = Scene(articulation, (Inertia(), *contact_terms(articulation, colliders, obstacles)), still)
    q, v = articulation.rest[None].clone(), torch.zeros(1, articulation.nv, dtype=torch.float64)
    q[0, 2], v[0, 2] = 0.5, -speed
    rollout = rolled_out(scene, dt, dt * (3 + math.ceil(1 / (speed * dt))), q, v)
    beside = rollout.q[:, 0, 2] - (rollout.q[:, 0, 9] if plate == "link" else 0.0)
    assert float(beside.min()) > 0
    assert float(rollout.v[-1, 0, 2]) > -0.1 * speed
    assert bool(rollout.solved.all())
    assert not bool((rollout.hazards & ~int(Hazard.OVERLAPPED)).any())  # at 100 m/s the contact itself gives way by a centimetre


SOLIDS: dict[str, Surface] = {
    "box": BoxSurface(torch.tensor([[0.3, 0.2, 0.1]], dtype=torch.float64)),
    "ball": SphereSurface(torch.tensor([0.1], dtype=torch.float64)),
    "capsule": SegmentSurface(
        torch.tensor([[0.0, 0.0, -0.2]], dtype=torch.float64),
        torch.tensor([[0.0, 0.1, 0.2]], dtype=torch.float64),
        torch.tensor([0.1], dtype=torch.float64),
    ),
}


@pytest.mark.parametrize("solid", SOLIDS)
def test_tangent_planes_stand_in_for_what_is_passed(solid: str) -> None:
    """Where the free motion leads deep into the solid, the field is the plane that touches it nearest to the start; where only
    other forces may, the solid's own down to a quarter of its thickness and the plane from the middle on; else its own. Its normal
    is its derivative everywhere."""
    own = SOLIDS[solid]
    random = generator(3)
    start = 2 * torch.rand(400, 3, dtype=torch.float64, generator=random) - 1
    freely, further = torch.rand(2, 400, dtype=torch.float64, generator=random)
    tangent = Tangent.before(own, start, freely, freely + 0.3 * further, 0.2)
    distance = own.field(start).distance
    led = (distance > 0) & (freely > distance + 0.05)
    lost = (distance > 0) & (freely + 0.3 * further > distance + 0.1)
    assert torch.equal(tangent.passed, led | lost)
    assert torch.equal(tangent.near, ~led)
    assert min(int(x.sum()) for x in (led, lost & ~led, ~lost & ~led)) > 20
    assert float((tangent.field(start).distance - distance).abs().max()) <= 1e-15
    there = start + 0.3 * torch.randn(400, 3, dtype=torch.float64, generator=random)
    field, alone = tangent.field(there), own.field(there).distance
    height = ((there - start) * own.field(start).direction).sum(-1) + distance
    kept, plane = ~tangent.passed | (~led & (height >= -0.05)), led | (lost & (height <= -0.1))
    assert torch.equal(field.distance[kept], alone[kept])
    assert float((field.distance - height)[plane].abs().max()) <= 1e-15
    smooth = (alone > 1e-3) | plane
    slope = derivative(lambda d: tangent.field(there + d).distance, 3, (400,), largest=1e-4)
    assert relative_error(field.normal[smooth][..., None], slope[smooth][..., None]) <= 1e-7
    assert float(field.curvature[plane].abs().max()) == 0
    assert torch.equal(field.curvature[kept], own.field(there).curvature[kept])


def test_tangent_planes_bend_as_they_take_over() -> None:
    """The curvature is the derivative of the normal, in the layer where a ball's own field goes over into the plane's too, and no
    point is pushed towards the other side."""
    ball, random = SOLIDS["ball"], generator(4)
    start = torch.nn.functional.normalize(torch.randn(400, 3, dtype=torch.float64, generator=random), dim=-1)
    still, far = torch.zeros(400, dtype=torch.float64), torch.full((400,), 2.0, dtype=torch.float64)
    tangent = Tangent.before(ball, start, still, far, 0.2)
    beside = torch.randn(400, 3, dtype=torch.float64, generator=random) * 0.1
    there = start * torch.linspace(-0.02, 0.08, 400, dtype=torch.float64)[:, None] + beside
    field = tangent.field(there)
    slope = derivative(lambda d: tangent.field(there + d).normal, 3, (400,), largest=1e-5)
    assert relative_error(field.curvature, slope) <= 1e-6
    assert float((field.normal * start).sum(-1).min()) >= 0


def test_thickness() -> None:
    """The least width of convex solids, also of one that is turned in its frame; half-spaces and terrains have no other side."""
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])  # between the slanted face and the corner: 1/√3
    assert thickness_of(ConvexHull(corner)) == pytest.approx(1 / math.sqrt(3), rel=1e-12)
    assert thickness_of(Box((0.3, 0.2, 0.1))) == pytest.approx(0.2)
    assert thickness_of(Sphere(0.1)) == pytest.approx(0.2)
    assert thickness_of(Capsule(0.1, 0.5)) == pytest.approx(0.2)
    assert thickness_of(Cylinder(0.4, 0.05)) == pytest.approx(0.1)
    assert thickness_of(SHEET) == 0
    assert math.isinf(HalfSpace().thickness)
    assert math.isinf(Obstacle("hills", HeightField(np.zeros((4, 4)), (1.0, 1.0))).thickness)


@pytest.mark.parametrize(("overlap", "hazard"), [(0.001, 0), (0.02, int(Hazard.OVERLAPPED))])
def test_overlap_at_the_start_is_a_hazard(overlap: float, hazard: int) -> None:
    """Boxes that begin a step more than the slack, 1 cm, inside each other: the world says so, and the others do not."""
    articulation = Articulation.from_links([solid_box(name, (0.1, 0.1, 0.1), 1.0) for name in "ab"])
    colliders = [Collider(name, name, Box((0.1, 0.1, 0.1))) for name in "ab"]
    still = torch.zeros(3, dtype=torch.float64)
    scene = Scene(articulation, (Inertia(), *contact_terms(articulation, colliders)), still)
    q = articulation.rest.repeat(2, 1)
    q[:, 9] = q.new_tensor([0.2 - overlap, 0.3])
    simulator = Simulator(scene, 0.01)
    state = simulator.initial_state(q)
    after, solution = simulator.step(state)
    assert bool(solution.solved.all())
    assert (after.hazards & int(Hazard.OVERLAPPED)).tolist() == [hazard, 0]
