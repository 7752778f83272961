"""What a friction law is: a drag g ≥ 0 of every candidate, in scalars; the force is f∥ = −g u, u the slip over the step."""

from __future__ import annotations

from typing import Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from pbfd_torch.tensors.vectors import dot
from pbfd_torch.tensors.worlds import Worlds


class FrictionLaw(Protocol):
    """Tangential force of a contact law. All arguments are broadcastable to `[*, n]`: the normal force N [N] and its slope dN/dd,
    the depth d [m], the size of the slip y = ‖u‖ [m], and dt [s]."""

    def drag(self, normal: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> Tensor:
        """g [N/m] `[*, n]`."""
        ...

    def drag_slopes(self, normal: Tensor, normal_slope: Tensor, depth: Tensor, size: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """dg/dd, N following d, and (∂g/∂y)/y, zero at y = 0: each `[*, n]`."""
        ...

    def take(self, worlds: Worlds) -> Self:
        """The same law with the parameters of some worlds."""
        ...


@runtime_checkable
class SlipLaw(FrictionLaw, Protocol):
    """A friction law whose force is the gradient of a scalar of the slip while the normal force and the depth are held still."""

    def slip_energy(self, normal: Tensor, depth: Tensor, slip: Tensor, dt: Tensor) -> Tensor:
        """The scalar [J] `[*, n]` whose gradient by the slip `[*, n, 3]` is minus the force, 0 at zero slip."""
        ...

    def widened(self, factor: float) -> Self:
        """The same law, smooth over a `factor` ≥ 1 times wider range of slip speeds."""
        ...


@runtime_checkable
class ByDepth(Protocol):
    """A law that goes by the depth, with a stiffness of its own, and not by the normal force."""

    @property
    def stiffness(self) -> float | Tensor:
        """C∥."""
        ...


@runtime_checkable
class Lifting(Protocol):
    """A law that pushes along the normal as well, by a force f* that depends on the slip."""

    def lift(self, depth: Tensor, size: Tensor) -> Tensor:
        """f* [N] `[*, n]` ≥ 0, out of the obstacle."""
        ...

    def lift_slopes(self, depth: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
        """∂f*/∂d and (∂f*/∂y)/y, zero at y = 0: each `[*, n]`."""
        ...


@runtime_checkable
class Storing(Protocol):
    """A law whose whole force, what it adds to the normal one included, is the gradient of a scalar."""

    def energy(self, depth: Tensor, slip: Tensor, dt: Tensor) -> Tensor:
        """That scalar [J] `[*, n]`."""
        ...


def slip_size(slip: Tensor) -> Tensor:
    """‖u‖ of `[*, 3]`, with derivatives of every order at u = 0, where they are set to zero."""
    square = dot(slip, slip)
    moves = square > 0
    return torch.where(moves, torch.where(moves, square, torch.ones_like(square)).sqrt(), torch.zeros_like(square))


def per_size(slope: Tensor, size: Tensor) -> Tensor:
    """slope/y, zero at y = 0, where only its product with u uᵀ counts, which vanishes."""
    moves = size > 0
    return torch.where(moves, slope / torch.where(moves, size, torch.ones_like(size)), torch.zeros_like(slope))
