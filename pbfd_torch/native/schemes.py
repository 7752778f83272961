"""The integrators that the core knows: their functions there, and their states as it has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.integrators.bdf2 import Bdf2, FourPoses
from pbfd_torch.integrators.energy_momentum import EnergyMomentum, Velocities
from pbfd_torch.integrators.implicit_euler import ImplicitEuler, Positions
from pbfd_torch.integrators.integrator import State
from pbfd_torch.integrators.runge_kutta import RungeKutta
from pbfd_torch.integrators.variational import Variational
from pbfd_torch.native.calls import whole
from pbfd_torch.native.plan import Plan

COORDINATE, FREEDOM, NUMBER = (0, 1, 0), (0, 0, 1), (0, 0, 0)  # widths of a field, in nodes, nq and nv


@dataclass(frozen=True)
class Scheme:
    """Attributes:
    function, start: that of steps and that of starts.
    state: the class of its states.
    widths: of their fields, in the order of the core: how many numbers, in nodes, nq and nv; none: one for each world.
    """

    function: str
    start: str
    state: type[State]
    widths: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)

    def shapes(self, plan: Plan) -> dict[str, tuple[int, ...]]:
        """What the fields hold for each world."""
        counts = plan.sizes[:3]
        return {name: (sum(a * b for a, b in zip(w, counts, strict=True)),) if any(w) else () for name, w in self.widths.items()}

    def fields(self, state: State, plan: Plan) -> dict[str, Tensor]:
        """Those of a state, all worlds one after the other; its memory last, where there are anchors."""
        batch = tuple(state.q.shape[:-1])
        given = self._inward(state, plan)
        given = {name: whole(x, batch if self.widths[name] == NUMBER else (*batch, x.shape[-1])) for name, x in given.items()}
        if plan.remembered:
            parts = sorted(zip(plan.memory, state.memory, strict=True), key=lambda x: x[0][0])
            given["memory"] = whole(torch.cat([x.flatten(-2) for _, x in parts], -1), (*batch, plan.remembered))
        return given

    def restored(self, found: dict[str, Tensor], plan: Plan) -> dict[str, Any]:
        """The fields of a state again, of what the core has found."""
        return found

    def _inward(self, state: State, plan: Plan) -> dict[str, Tensor]:
        return {name: getattr(state, name) for name in self.widths}


class _OnPoses(Scheme):
    """With the poses of nodes for those of links (`Seats`)."""

    def _inward(self, state: State, plan: Plan) -> dict[str, Tensor]:
        assert isinstance(state, FourPoses)
        history, moves = plan.seats.of_nodes(state.history), torch.cat(state.moves, -1)
        return {"q": state.q, "history": history, "moves": moves, "push": state.push}

    def restored(self, found: dict[str, Tensor], plan: Plan) -> dict[str, Any]:
        """See `Scheme`."""
        return found | {"history": plan.seats.of_links(found["history"], 3), "moves": tuple(found["moves"].chunk(3, -1))}


ON_POSITIONS = Scheme(
    *("pbfd_implicit_euler", "pbfd_start_implicit_euler", Positions),
    {"q": COORDINATE, "q_previous": COORDINATE, "acceleration": FREEDOM},
)
WITH_VELOCITIES = Scheme(
    *("pbfd_energy_momentum", "pbfd_start_energy_momentum", Velocities),
    {"q": COORDINATE}
    | dict.fromkeys(("v", "push", "steady", "lag", "average"), FREEDOM)
    | dict.fromkeys(("gained", "surplus", "peak"), NUMBER),
)
SCHEMES: dict[type, Scheme] = {
    EnergyMomentum: WITH_VELOCITIES,
    RungeKutta: WITH_VELOCITIES,
    ImplicitEuler: ON_POSITIONS,
    Variational: ON_POSITIONS,
    Bdf2: _OnPoses(
        *("pbfd_bdf2", "pbfd_start_bdf2", FourPoses),
        {"q": COORDINATE, "history": (36, 0, 0), "moves": (0, 0, 3), "push": NUMBER},
    ),
}
