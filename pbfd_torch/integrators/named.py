"""The integrators by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pbfd_torch.integrators.bdf2 import Bdf2
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.integrators.runge_kutta import RungeKutta
from pbfd_torch.integrators.variational import Variational

INTEGRATORS: dict[str, Callable[[], Integrator[Any]]] = {
    "implicit-euler": ImplicitEuler,
    "bdf2": Bdf2,
    "variational": Variational,
    "energy-momentum": EnergyMomentum,
    "runge-kutta": RungeKutta,
}
