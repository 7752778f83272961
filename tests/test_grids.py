"""Obstacles on smooth grids, distances and heights: against closed forms and central differences, without jumps, per world."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.distance_grid import DistanceGrid
from pbfd_torch.contact.height_field import HeightField
from pbfd_torch.contact.splines import coefficients_through, evaluate
from pbfd_torch.contact.surface import Surface
from pbfd_torch.tensors.worlds import Worlds
from tests.finite_differences import derivative, relative_error
from tests.grid_points import node_points
from tests.random_numbers import uniform as random


def rough_grid(dtype: torch.dtype = torch.float64) -> DistanceGrid:
    return DistanceGrid.through(0.1 * random(6, 5, 7).numpy(), (0.3, -0.2, 0.1), 0.25, dtype)


def rough_terrain(dtype: torch.dtype = torch.float64) -> Surface:
    return HeightField(0.1 * random(6, 7).numpy(), (0.25, 0.4)).surface(dtype)


ROUGH = pytest.mark.parametrize("make", [rough_grid, rough_terrain])


def rough_points() -> Tensor:
    """Points in the middle parts of cells, inside the grids above and up to two cells outside."""
    cells = torch.cartesian_prod(*[torch.arange(-2.0, n + 1, 2, dtype=torch.float64) for n in (6, 5, 7)])
    offset = torch.tensor((0.3, -0.2, 0.1), dtype=torch.float64)
    return offset + 0.25 * (cells + 0.2 + 0.6 * random(len(cells), 3, seed=1))


@pytest.mark.parametrize("shape", [(2,), (3,), (9,), (4, 2), (5, 6), (2, 3, 4), (6, 5, 4)])
def test_spline_takes_its_values_at_the_nodes(shape: tuple[int, ...]) -> None:
    values = random(*shape)
    nodes = torch.cartesian_prod(*[torch.arange(n, dtype=torch.float64) for n in shape]).reshape(-1, len(shape))
    spacing = torch.linspace(0.1, 0.3, len(shape), dtype=torch.float64)
    coefficients = torch.as_tensor(coefficients_through(values.numpy()))
    (found,) = evaluate(coefficients, -spacing, spacing, (nodes - 1) * spacing, 0)
    torch.testing.assert_close(found, values.flatten(), rtol=0, atol=1e-13)


@ROUGH
def test_normal_and_curvature_are_the_derivatives(make: Callable[[], Surface]) -> None:
    surface, points = make(), rough_points()
    field = surface.field(points)
    slope = derivative(lambda d: surface.field(points + d).distance, 3, (len(points),))
    bend = derivative(lambda d: surface.field(points + d).normal, 3, (len(points),))
    assert relative_error(field.normal.unsqueeze(-1), slope.unsqueeze(-1)) < 1e-7
    assert relative_error(field.curvature, bend, 1.0) < 1e-7
    torch.testing.assert_close(field.curvature, field.curvature.mT, rtol=0, atol=1e-11)
    assert not field.flat


@ROUGH
def test_autograd_gives_the_same_and_stays_finite(make: Callable[[], Surface]) -> None:
    grid = rough_grid()
    corners = torch.cat((node_points(grid), rough_points(), grid.origin - 1e3 * torch.eye(3)))
    points = corners.clone().requires_grad_()
    field = make().field(points)
    (slope,) = torch.autograd.grad(field.distance.sum(), points, create_graph=True)
    torch.testing.assert_close(slope, field.normal)
    bend = torch.stack([torch.autograd.grad(n.sum(), points, retain_graph=True)[0] for n in field.normal.unbind(-1)], -2)
    kinks = (corners == grid.origin) | (corners == grid.last)  # the second derivative jumps at the border of the grid
    inner = ~kinks.any(-1)
    torch.testing.assert_close(bend[inner], field.curvature[inner], rtol=1e-9, atol=1e-9)
    (third,) = torch.autograd.grad(field.curvature.sum(), points)
    assert bend.isfinite().all()
    assert third.isfinite().all()


@ROUGH
def test_no_jumps_between_cells_and_at_the_border(make: Callable[[], Surface]) -> None:
    grid = rough_grid()
    surface = make()
    nodes = torch.cartesian_prod(*[torch.linspace(-3, 9, 13, dtype=torch.float64)] * 3)
    points = grid.origin + grid.spacing * nodes
    if make is rough_terrain:
        points = torch.tensor((-0.625, -1.2, 0.0)) + torch.tensor((0.25, 0.4, 0.1)) * nodes
    inside = ((points > grid.origin + 1e-9) & (points < grid.last - 1e-9)).all(-1)
    for axis in torch.eye(3, dtype=torch.float64):
        before, after = (surface.field(points + side * 2e-15 * axis) for side in (-1, 1))
        assert (before.distance - after.distance).abs().max() < 1e-12
        assert (before.normal - after.normal).abs().max() < 1e-12
        if make is rough_grid:
            assert (before.curvature - after.curvature)[inside].abs().max() < 1e-10


@ROUGH
def test_dtype_batches_and_worlds(make: Callable[[torch.dtype], Surface]) -> None:
    surface, points = make(torch.float64), rough_points()
    whole = surface.field(points)
    batched = surface.field(points.view(2, 1, 5, 10, 3))
    assert batched.curvature.shape == (2, 1, 5, 10, 3, 3)
    alone = [surface.field(point) for point in points[:9].split(1)]
    for name in ("distance", "normal", "curvature"):
        assert torch.equal(getattr(batched, name).flatten(0, 3), getattr(whole, name))
        assert torch.equal(torch.cat([getattr(each, name) for each in alone]), getattr(whole, name)[:9])
    assert surface.field(points[:0]).curvature.shape == (0, 3, 3)
    single = make(torch.float32).field(points.float())
    assert single.distance.dtype == single.normal.dtype == single.curvature.dtype == torch.float32
    torch.testing.assert_close(single.distance.double(), whole.distance, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(single.normal.double(), whole.normal, rtol=1e-4, atol=1e-4)
    worlds = surface.take(Worlds((4,), torch.tensor([2, 0])))
    assert torch.equal(worlds.field(points).distance, whole.distance)


def test_distance_grid_of_a_smooth_solid_converges() -> None:
    directions = torch.nn.functional.normalize(random(500, 3) - 0.5, dim=-1)
    depth = 0.2 * (random(500, seed=1) - 0.5)
    errors = []
    for n in (17, 33, 65):
        axes = np.meshgrid(*[np.linspace(-1.2, 1.2, n)] * 3, indexing="ij")
        grid = DistanceGrid.through(np.linalg.norm(axes, axis=0) - 0.8, (-1.2, -1.2, -1.2), 2.4 / (n - 1))
        field = grid.field((0.8 + depth).unsqueeze(-1) * directions)
        errors.append((float((field.distance - depth).abs().max()), float((field.normal - directions).norm(dim=-1).max())))
    (d0, n0), (d1, n1), (d2, n2) = errors
    assert d0 / d1 > 12  # fourth order
    assert d1 / d2 > 12
    assert n0 / n1 > 7  # third order
    assert n1 / n2 > 7
    assert d2 < 1e-6


def test_height_field_of_a_plane_is_exact() -> None:
    field = HeightField.from_function(lambda x, y: 0.3 * x - 0.7 * y + 0.1, (3, 2), 0.3)
    assert field.heights.shape == (11, 8)
    points = (random(300, 3) - 0.5) * torch.tensor((3.0, 2.0, 4.0))
    normal = torch.tensor((-0.3, 0.7, 1.0), dtype=torch.float64) / 1.58**0.5
    found = field.surface().field(points)
    assert (found.distance - ((points * normal).sum(-1) - 0.1 / 1.58**0.5)).abs().max() < 1e-12
    assert (found.normal - normal).abs().max() < 1e-12
    assert found.curvature.abs().max() < 1e-10


def test_height_field_of_a_paraboloid() -> None:
    surface = HeightField.from_function(lambda x, y: 0.2 * x * x - 0.1 * y * y + 0.3 * x * y, (16, 16), 0.25).surface()
    xy = 2 * (random(200, 2) - 0.5)
    x, y = xy.unbind(-1)
    height = 0.2 * x * x - 0.1 * y * y + 0.3 * x * y
    slope = torch.stack((0.4 * x + 0.3 * y, 0.3 * x - 0.2 * y), -1)
    bend = torch.tensor(((0.4, 0.3), (0.3, -0.2)), dtype=torch.float64)
    steepness = (1 + (slope * slope).sum(-1)).rsqrt()
    normal = torch.cat((-slope, torch.ones_like(x).unsqueeze(-1)), -1) * steepness.unsqueeze(-1)
    foot = torch.cat((xy, height.unsqueeze(-1)), -1)
    on = surface.field(foot)
    assert on.distance.abs().max() < 1e-12
    assert (on.normal - normal).abs().max() < 1e-12
    tangent = slope / slope.norm(dim=-1, keepdim=True)
    curvature = (tangent * (tangent @ bend)).sum(-1) * steepness**3
    off = 0.5 * curvature * (slope * slope).sum(-1)
    for depth in (0.02, -0.02, 0.01, 0.005):
        error = surface.field(foot + depth * normal).distance - depth
        assert (error / depth**2 - off).abs().max() < 2 * abs(depth)


def test_height_field_turns_level_beyond_its_border() -> None:
    field = HeightField.from_function(lambda x, y: 0.5 * x + 0 * y, (4, 4), 0.5)
    x = torch.linspace(2, 30, 2801, dtype=torch.float64)
    on = field.surface().field(torch.stack((x, 7 * torch.ones_like(x), torch.zeros_like(x)), -1))
    level = x >= 3
    torch.testing.assert_close(on.distance[level], torch.full_like(x[level], -1.25), rtol=0, atol=1e-12)
    assert (on.normal[level] - torch.tensor((0, 0, 1))).abs().max() < 1e-12
    assert on.normal.isfinite().all()
