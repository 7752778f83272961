"""Worlds that cannot be stepped stand still: those that are not finite or beyond the bounds (`tree.bounds`), where a step starts or
where it ends. They keep the state that they had and say `NON_FINITE`; the others never notice.

A world that starts so makes its step from NaN: nothing is near NaN, so no contact is sought, and the solver gives it up at its
first evaluation. That needs no list of worlds, which a device would make the host wait for.
"""

from __future__ import annotations

import dataclasses
from typing import TypeVar

import torch
from torch import Tensor

from pbfd_torch.integrators.integrator import Integrator, State
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.solvers.per_world import chosen
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.bounds import near, slow

S = TypeVar("S", bound=State)


def departing(articulation: Articulation, integrator: Integrator[S], state: S, dt: Tensor, control: Tensor | None) -> S:
    """The state with NaN for the configuration of worlds that are not to be stepped under a control `[*batch, nu]`."""
    fit = near(state.q) & slow(integrator.velocity(articulation, state, dt), articulation.topology.turns, dt)
    if control is not None:
        fit = fit & torch.isfinite(control).all(-1)
    return replaced(state, q=torch.where(fit[..., None], state.q, torch.nan))


def arrived(
    articulation: Articulation, integrator: Integrator[S], state: S, dt: Tensor, end: S, solution: Solution
) -> tuple[S, Solution]:
    """The end of a step from a state, and its solution, with worlds that got lost back in that state; their time goes on."""
    fit = near(end.q) & torch.isfinite(integrator.velocity(articulation, end, dt)).all(-1)
    fit = fit & (solution.status != int(Status.NON_FINITE))
    still = replaced(
        state, time=end.time, hazards=torch.zeros_like(end.hazards), memory=state.memory or end.memory, **_blank(state, end)
    )
    solution = dataclasses.replace(solution.marked(~fit, Status.NON_FINITE), q=chosen(fit, solution.q, state.q))
    return chosen(fit, end, still), solution


def _blank(state: State, end: State) -> dict[str, Tensor]:
    """What a state does not hold yet, and its step's end does, as zeros."""
    ends = {field.name: getattr(end, field.name) for field in dataclasses.fields(end) if getattr(state, field.name) is None}
    return {name: torch.zeros_like(x) for name, x in ends.items() if x is not None}
