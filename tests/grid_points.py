"""Points of grids, for tests of distances on grids."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.contact.distance_grid import DistanceGrid


def node_points(grid: DistanceGrid) -> Tensor:
    axes = [torch.arange(size - 2, dtype=torch.float64) for size in grid.coefficients.shape]
    return grid.origin + grid.spacing * torch.cartesian_prod(*axes)
