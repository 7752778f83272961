"""What was measured of the runs of an experiment, and how far a simulation is from it, in standard deviations of the noise."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Protocol, Self

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import difference, place


class Measurement(Protocol):
    """Samples at the ends of steps."""

    @property
    def steps(self) -> int:
        """How many steps they cover."""
        ...

    def first(self, steps: int) -> Self:
        """Those of the first so many steps."""
        ...

    def residual(self, articulation: Articulation, q: Tensor) -> Tensor:
        """How far the simulated q `[steps, *batch, runs, nq]` is from them, `[steps, *batch, runs, k]`, in standard deviations."""
        ...


@dataclass(frozen=True, eq=False)
class Configurations:
    """The whole configuration after every step.

    Attributes:
        q: `[steps, *batch, runs, nq]`, quaternions at unit norm; NaN in a row where it was not measured.
        deviation: `[nv]` of the noise in tangent coordinates [m, rad].
    """

    q: Tensor
    deviation: Tensor

    def __post_init__(self) -> None:
        _require_positive("deviation", self.deviation)
        if self.q.ndim < 3:
            raise InputError(f"q has shape {tuple(self.q.shape)}: must be [steps, runs, nq]")

    @property
    def steps(self) -> int:
        """See `Measurement`."""
        return len(self.q)

    def first(self, steps: int) -> Self:
        """See `Measurement`."""
        return dataclasses.replace(self, q=self.q[:steps])

    def residual(self, articulation: Articulation, q: Tensor) -> Tensor:
        """See `Measurement`."""
        samples = _aligned(self.q, q.ndim)
        known = torch.isfinite(samples).all(-1, keepdim=True)
        measured = torch.where(known, samples, articulation.rest)
        return torch.where(known, difference(articulation, measured, q) / self.deviation, 0.0)


@dataclass(frozen=True, eq=False)
class Markers:
    """Where points of links were after every step, as a camera sees them.

    Attributes:
        links: `[k]` long, the link that carries each marker; places: `[k, 3]` where, in the link's frame [m].
        points: `[steps, *batch, runs, k, 3]` in the world [m]; NaN where a marker was not seen.
        deviation: of the noise of a coordinate [m].
    """

    links: Tensor
    places: Tensor
    points: Tensor
    deviation: float

    def __post_init__(self) -> None:
        _require_positive("deviation", torch.tensor(self.deviation))
        if self.points.ndim < 4 or self.points.shape[-2:] != self.places.shape or self.links.shape != self.places.shape[:1]:
            shapes = ", ".join(str(tuple(x.shape)) for x in (self.links, self.places, self.points))
            raise InputError(f"links, places and points have shapes {shapes}: must be [k], [k, 3], [steps, runs, k, 3]")

    @property
    def steps(self) -> int:
        """See `Measurement`."""
        return len(self.points)

    def first(self, steps: int) -> Self:
        """See `Measurement`."""
        return dataclasses.replace(self, points=self.points[:steps])

    def seen(self, articulation: Articulation, q: Tensor) -> Tensor:
        """The markers `[*batch, k, 3]` at q `[*batch, nq]`."""
        poses = place(articulation, q).poses[..., self.links, :3, :]
        return (poses[..., :3] @ self.places[..., None]).squeeze(-1) + poses[..., 3]

    def residual(self, articulation: Articulation, q: Tensor) -> Tensor:
        """See `Measurement`."""
        seen = self.seen(articulation, q)
        points = _aligned(self.points, seen.ndim)
        known = torch.isfinite(points)
        gap = seen - torch.where(known, points, 0.0)
        return torch.where(known, gap / self.deviation, 0.0).flatten(-2)


def _aligned(samples: Tensor, rank: int) -> Tensor:
    """The samples with as many dimensions as the simulation, whose own leading ones of the batch come after the steps."""
    if samples.ndim > rank:
        raise InputError(f"there are data sets of shape {tuple(samples.shape)}: x must have a row for each of them")
    return samples.reshape(len(samples), *(1,) * (rank - samples.ndim), *samples.shape[1:])


def _require_positive(name: str, value: Tensor) -> None:
    if not bool(((value > 0) & torch.isfinite(value)).all()):
        raise InputError(f"{name} is {value.tolist()}: must be > 0 and finite")
