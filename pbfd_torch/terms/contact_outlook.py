"""How contacts will go along a direction: their depths and slips as polynomials in the length."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from pbfd_torch.tensors.vectors import dot, rotated
from pbfd_torch.terms.friction_law import Lifting
from pbfd_torch.terms.touching import ContactForce


def contact_outlook(force: ContactForce, velocity: Tensor, acceleration: Tensor) -> Callable[[Tensor], Tensor]:
    """The work N ḋ + G u·u̇ [J] of all candidates at lengths a, `[k, *batch] → [k, *batch]`.

    velocity, acceleration: of the surfaces at the candidates relative to the solids `[*batch, n, 3]`. Each candidate moves on a
    parabola: its depth and the square of its slip are polynomials in a; the normal is held where it is but for the depth."""
    at, law, dt = force.at, force.friction, force.dt
    lifting: object = law
    sinks, faster = -dot(velocity, at.normal), -dot(acceleration, at.normal)
    if law is not None:
        slip = at.slip
        first = velocity + sinks[..., None] * at.normal
        second = acceleration + faster[..., None] * at.normal
        size, along, square = dot(slip, slip), dot(slip, first), dot(first, first) + dot(slip, second)
        cube, fourth = dot(first, second), dot(second, second)
    if at.bend is not None:
        faster = faster - dot(rotated(at.bend(), velocity), velocity)

    def work(length: Tensor) -> Tensor:
        a = length[..., None]
        sunk = a * (sinks + 0.5 * a * faster)
        deep = at.depth + (sunk if at.steepness is None else at.steepness * sunk)
        push = force.normal_force.push(deep)
        speed = sinks + a * faster
        if law is None:
            return (push * speed).sum(-1)
        far = (size + a * (2 * along + a * (square + a * (cube + 0.25 * a * fourth)))).clamp_min(0).sqrt()
        onward = along + a * (square + a * (1.5 * cube + 0.5 * a * fourth))
        added = law.drag(push, deep, far, dt) * onward
        if isinstance(lifting, Lifting):
            added = added + lifting.lift(deep, far) * speed
        return (push * speed + (added if force.grip is None else force.grip * added)).sum(-1)

    return work
