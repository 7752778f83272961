"""Where curved bodies touch: the support point of an ellipsoid, which moves over the body as it turns.

An ellipsoid with centre c and form M = R diag(a²) Rᵀ, semi-axes a ≥ 0, reaches h = √(nᵀM n) from its centre towards a plane with
normal n, at the arm s = −M n/h. A ball has a = (ρ, ρ, ρ), the rim of a cylinder (r, r, 0), a point (0, 0, 0). So its depth is
d = h + δ − φ(c), and its force acts at p = c + s. What rolls has the slip u = (1 − nnᵀ)(c − c₀ + ϕ × s), zero where nothing slips.

By the twist W = (ω, v) of the body: δ(M n) = ω × M n − M (ω × n) + M δn, δh = (½ nᵀδM n + M n · δn)/h, δs = −δ(M n)/h + M n δh/h².
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pbfd_torch.tensors.vectors import cross, dot, rotated, rows
from pbfd_torch.terms.touching import Touching
from pbfd_torch.tree.rotations import log_jacobian_left, skew

_POINT = 1e-12  # [m] a smaller reach is that of a point


def reaching(form: Tensor, normal: Tensor) -> Tensor:
    """h `[*, n]` [m] of forms M `[*, n, 3, 3]` [m²] towards planes with normals `[*, n, 3]`."""
    return dot(rotated(form, normal), normal).clamp_min(_POINT**2).sqrt()


@dataclass(frozen=True, eq=False, kw_only=True)
class Supported(Touching):
    """Ellipsoids beside their solids. `form`: M `[*, n, 3, 3]` in world axes [m²]. `radius` is None: h stands for it."""

    form: Tensor

    @staticmethod
    def of(centers: Touching, form: Tensor) -> Supported:
        """With these centres, which have a turn; the depth is that of the ellipsoids already."""
        fields = {field.name: getattr(centers, field.name) for field in dataclasses.fields(Touching)}
        return Supported(**(fields | {"radius": None}), form=form)

    @property
    def _rolled(self) -> Tensor:
        assert self.turn is not None
        return self.turn

    @cached_property
    def _spread(self) -> Tensor:
        return rotated(self.form, self.normal)

    @cached_property
    def _reach(self) -> Tensor:
        return reaching(self.form, self.normal)

    @cached_property
    def arm(self) -> Tensor:
        """s `[*, n, 3]` [m]; that of a point is zero, whatever its form is differentiated by."""
        solid = (self._reach > _POINT)[..., None]
        return torch.where(solid, -self._spread / torch.where(solid, self._reach[..., None], 1.0), 0.0)

    @property
    def points(self) -> Tensor:
        """p `[*, n, 3]`."""
        return self.centers + self.arm

    @cached_property
    def travel(self) -> Tensor:
        """m `[*, n, 3]`."""
        return self.moved + cross(self._rolled, self.arm)

    @cached_property
    def _spread_slope(self) -> Tensor:
        """∂(M n)/∂W `[*, n, 3, 6]`, but for the turn of n."""
        by_turn = self.form @ skew(self.normal) - skew(self._spread)
        return torch.cat((by_turn, torch.zeros_like(by_turn)), -1)

    @cached_property
    def _reach_slope(self) -> Tensor:
        """∂h/∂W `[*, n, 6]`."""
        slope = 0.5 * rows(self.normal, self._spread_slope)
        if self.tilt is not None:
            slope = slope + rows(self._spread, self.tilt)
        return slope / self._reach[..., None]

    @cached_property
    def _arm_slope(self) -> Tensor:
        """∂s/∂W `[*, n, 3, 6]`."""
        spread = self._spread_slope
        if self.tilt is not None:
            spread = spread + self.form @ self.tilt
        reach = self._reach[..., None, None]
        return (self._spread[..., None] * self._reach_slope[..., None, :] / reach - spread) / reach

    @cached_property
    def sinks(self) -> Tensor:
        """See `Touching`."""
        return self.sinking(self.shift) - self._reach_slope

    @property
    def travel_slope(self) -> Tensor:
        """See `Touching`."""
        roll = skew(self.arm) @ log_jacobian_left(self._rolled)
        move = torch.cat((self.shift[..., :3] - roll, self.shift[..., 3:]), -1)
        return move + skew(self._rolled) @ self._arm_slope

    def bulge(self, spin: Tensor) -> Tensor:
        """See `Touching`: h'' less what ω̇ makes of it, with η' = −ω × n: (η'ᵀM η' − (s · η')²)/h − n · (ω × (ω × s))."""
        turning = -cross(spin, self.normal)
        spread = dot(rotated(self.form, turning), turning) - dot(self.arm, turning).square()
        return spread / self._reach - dot(cross(spin, cross(spin, self.arm)), self.normal)

    def wandering(self, force: Tensor) -> Tensor:
        """See `Touching`: p moves by δs where a material point there would by ω × s."""
        beside = torch.cat((skew(self.arm), torch.zeros_like(self.form)), -1)
        return skew(force) @ (self._arm_slope + beside)
