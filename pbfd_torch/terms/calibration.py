"""Stiffnesses for what is wanted of a contact, a friction coefficient or a penetration, and back.

A contact point that carries a load W [N] while it slips at v [m/s] moves by y = v Δt a step. Whatever is a number may be a tensor
too; shapes broadcast.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.checks import require_non_negative, require_positive
from pbfd_torch.terms.friction_law import FrictionLaw, Lifting
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbd_friction import PbdFriction
from pbfd_torch.terms.pbfd_friction import PbfdFriction

ROUNDS = 60  # of Newton's method on convex functions from their outer side; it halves the error at a double root, else squares it


def normal_force_for(
    mass: float | Tensor, gravity: float, points: int, penetration: float = 1e-3, exponent: float = 2.0
) -> NormalForce:
    """The normal force at which a body of `mass` [kg] under `gravity` [m/s²] rests `penetration` [m] deep on so many points:
    C⊥ = m g/(points · d^α). Raises `InputError` for what is not > 0."""
    return NormalForce.for_weight(load_per_point(mass, gravity, points), penetration, exponent)


def load_per_point(mass: float | Tensor, gravity: float, points: int) -> float | Tensor:
    """W = m g/points [N]. Raises `InputError` for what is not > 0."""
    for what, value, unit in (("mass", mass, "kg"), ("gravity", gravity, "m/s²"), ("points", points, "")):
        require_positive(what, value, unit)
    return mass * gravity / points


def rest_penetration(normal_force: NormalForce, load: float | Tensor) -> Tensor:
    """d = (W/C⊥)^{1/α} [m] `[*]`."""
    require_positive("load", load, "N")
    return (_tensor(load) / normal_force.stiffness) ** (1 / normal_force.exponent)


def sliding_penetration(
    law: FrictionLaw, normal_force: NormalForce, speed: float | Tensor, dt: float, load: float | Tensor = 1.0
) -> Tensor:
    """Depth [m] `[*]` at which the normal force and what the law adds to it carry the load while the point slips at `speed`."""
    size = _slip(speed, dt)
    depth = rest_penetration(normal_force, load)
    lifting: object = law
    if not isinstance(lifting, Lifting):
        return depth
    for _ in range(ROUNDS):
        push, slope = normal_force.force(depth)
        rises, _ = lifting.lift_slopes(depth, size)
        depth = depth - (push + lifting.lift(depth, size) - load) / (slope + rises)
    return depth


def effective_mu(
    law: FrictionLaw, normal_force: NormalForce, speed: float | Tensor, dt: float, load: float | Tensor = 1.0
) -> Tensor:
    """Friction per load of a point that slips at `speed` > 0 [m/s] at a step `dt` [s], `[*]`, for any law. The load does not matter
    to Coulomb's laws, nor to the PBFD laws where γ + 1 = α."""
    depth = sliding_penetration(law, normal_force, speed, dt, load)
    size = _slip(speed, dt)
    push, _ = normal_force.force(depth)
    return law.drag(push, depth, size, _tensor(dt)) * size / load


def calibrated_pbfd(
    law: PbfdFriction, mu: float | Tensor, normal_force: NormalForce, speed: float | Tensor, dt: float, load: float | Tensor = 1.0
) -> PbfdFriction:
    """The law with the C∥ = μ C⊥ d^{α−γ−1}/((β + 1) (v Δt)^{e+1}) at which `effective_mu` is μ; d: the penetration under the load.
    Exact at any load where γ + 1 = α. It holds at this speed and step only: friction goes with (v Δt)^{e+1}."""
    require_non_negative("μ", mu)
    _slip(speed, dt)
    depth = rest_penetration(normal_force, load)
    matching = normal_force.stiffness * depth ** (normal_force.exponent - law.gamma - 1)
    return law.calibrated(mu, matching, speed, dt)


def largest_pbd_mu(law: PbdFriction, normal_force: NormalForce, speed: float | Tensor, dt: float, load: float | Tensor) -> Tensor:
    """The largest `effective_mu` `[*]` that any C∥ gives to PBD at this speed, step and load: with d₀ the penetration at rest
    (β + 1)/(γ + 1) · α/(α + 1)^{1 + 1/α} · d₀/(v Δt), which is .385 d₀/(v Δt) for α = 2, β = γ = 1."""
    a = normal_force.exponent
    return _leverage(law, normal_force, speed, dt, load) * (a / (a + 1) ** (1 + 1 / a))


def calibrated_pbd(
    law: PbdFriction, mu: float | Tensor, normal_force: NormalForce, speed: float | Tensor, dt: float, load: float | Tensor
) -> PbdFriction:
    """The law with the smaller of the two C∥ at which `effective_mu` is μ; it holds at this speed, step and load only. With
    x = d/d₀ the depth solves (β + 1)/(γ + 1) (d₀/(v Δt)) x (1 − x^α) = μ. Raises `InputError` beyond `largest_pbd_mu`."""
    require_non_negative("μ", mu)
    most = largest_pbd_mu(law, normal_force, speed, dt, load)
    if bool((_tensor(mu) > most).any()):
        raise InputError(f"μ is {mu}: must be at most {most.tolist()}, the most that PBD can give at {speed} m/s and {dt} s")
    a = normal_force.exponent
    share = _tensor(mu) / _leverage(law, normal_force, speed, dt, load)
    x, outermost = torch.ones_like(share), (a + 1) ** (-1 / a)  # where x (1 − x^α) is largest
    for _ in range(ROUNDS):
        slope = (1 - (a + 1) * x**a).clamp_max(-1e-9)
        x = (x - (x * (1 - x**a) - share) / slope).clamp_min(outermost)
    depth = x * rest_penetration(normal_force, load)
    drag = (law.beta + 1) * _slip(speed, dt) ** law.beta * depth ** (law.gamma + 1)
    return replaced(law, stiffness=mu * load / drag)


def _leverage(law: PbdFriction, normal_force: NormalForce, speed: float | Tensor, dt: float, load: float | Tensor) -> Tensor:
    """(β + 1)/(γ + 1) d₀/(v Δt) `[*]`."""
    return (law.beta + 1) / (law.gamma + 1) * rest_penetration(normal_force, load) / _slip(speed, dt)


def _slip(speed: float | Tensor, dt: float) -> Tensor:
    """y = v Δt [m]."""
    require_positive("speed", speed, "m/s")
    require_positive("dt", dt, "s")
    return _tensor(speed * dt)


def _tensor(value: float | Tensor) -> Tensor:
    return value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
