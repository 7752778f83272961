"""Contact points and their Jacobians, for controllers, estimators and solvers of one's own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.integrators.integrator import State
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.contact_laws import ContactPoints
from pbfd_torch.terms.touching import shifting
from pbfd_torch.tree.kinematics import link_jacobians


@dataclass(frozen=True, eq=False)
class ContactJacobian:
    """The candidates of one contact term.

    Attributes:
        points: where they are, how deep, with which normal `[*batch, n, …]`; no force acts where nothing touches.
        jacobian: `[*batch, n, 3, nv]` J with J v the velocity [m/s] of the body's material point there, relative to that of the
            other body; −n·J v is how fast the depth grows where the obstacle stands still.
    """

    points: ContactPoints
    jacobian: Tensor


class Balanced(Protocol):
    """What knows the balance of a step: a `Simulator`, an `EagerStepper`."""

    def objective(self, state: Any, control: Tensor | None = None) -> BalanceObjective:
        """The balance of forces that the step from `state` solves."""
        ...


def contact_jacobians(simulator: Balanced, state: State, control: Tensor | None = None) -> list[ContactJacobian]:
    """Of every contact term in the scene's order, at a state, as the step that begins there sees them."""
    objective = simulator.objective(state, control)
    placement = objective.step.previous
    twists = link_jacobians(placement)
    found = []
    for term, prepared in zip(objective.terms, objective.prepared, strict=True):
        if not isinstance(term, Contact | BodyContact):
            continue
        points = term.points(prepared, placement)
        if isinstance(term, Contact):
            moves = twists[..., term.link, :, :]
        else:
            first, second = (_of_bodies(twists, index) for index in (prepared.slots.first, prepared.slots.second))
            moves = first - second
        found.append(ContactJacobian(points, shifting(points.point) @ moves))
    return found


def _of_bodies(twists: Tensor, index: Tensor) -> Tensor:
    """Twists `[*batch, nlink, 6, nv]` of bodies `[*batch, n]`, zero for obstacles, which come after the links."""
    links = twists.shape[-3]
    place = index.clamp_max(links - 1)[..., None, None].expand(*index.shape, *twists.shape[-2:])
    return twists.take_along_dim(place, -3) * (index < links)[..., None, None].to(twists.dtype)
