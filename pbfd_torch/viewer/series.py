"""What can be plotted of a rollout: named groups of curves over time, thinned to what a small plot can show."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pbfd_torch.looks.appearance import JointMark
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.solvers.objective import FALLBACKS
from pbfd_torch.viewer.film import Film

Curve = NDArray[np.float64]
_POINTS = 600  # of a curve at most


@dataclass(frozen=True, eq=False)
class Curves:
    """`time` `[n]` [s] and named curves `[n]` over it."""

    time: Curve
    lines: Mapping[str, Curve]


def quantities(film: Film) -> dict[str, Callable[[int], Curves]]:
    """By name, from the index of a world."""
    joints = {f"joint {mark.name}": _joint(film, mark) for mark in film.appearance.joints}
    return {title: _of(film, make) for title, make in _QUANTITIES.items()} | joints


def _numbers(value: torch.Tensor) -> Curve:
    array: Curve = value.detach().cpu().double().numpy()
    return array


def _of(film: Film, make: Callable[[Rollout], Mapping[str, torch.Tensor]]) -> Callable[[int], Curves]:
    def curves(world: int) -> Curves:
        lines = {name: _numbers(value.reshape(len(value), film.worlds)[:, world]) for name, value in make(film.rollout).items()}
        time = _numbers(film.rollout.time)
        length = len(next(iter(lines.values())))
        return thinned(Curves(time[-length:], lines))  # what belongs to a step is drawn at its end

    return curves


_QUANTITIES: dict[str, Callable[[Rollout], Mapping[str, torch.Tensor]]] = {
    "energy [J]": lambda r: {"total": r.energy, "kinetic": r.kinetic_energy, "potential": r.potential_energy},
    "momentum [kg m/s, kg m²/s]": lambda r: {
        "linear": torch.linalg.vector_norm(r.linear_momentum, dim=-1),
        "angular": torch.linalg.vector_norm(r.angular_momentum, dim=-1),
    },
    "penetration [mm]": lambda r: {"deepest": 1e3 * r.penetration},
    "iterations": lambda r: {"iterations": r.iterations, "evaluations": r.evaluations},
    "residual, log₁₀": lambda r: {"‖r/scale‖": r.residual_norm.clamp_min(1e-300).log10()},
    "fallbacks": lambda r: {name: r.fallbacks[..., k] for k, name in enumerate(FALLBACKS)},
    "steps within a step": lambda r: {"steps": r.substeps},
}


def _joint(film: Film, mark: JointMark) -> Callable[[int], Curves]:
    """The coordinates of a joint [rad or m]: one, or those of a ball or free joint."""
    last = mark.first + mark.size
    labels = {1: ("q",), 4: tuple("wxyz"), 7: ("px", "py", "pz", "w", "x", "y", "z")}[mark.size]

    def curves(world: int) -> Curves:
        q = film.rollout.q.reshape(film.frames, film.worlds, -1)[:, world, mark.first : last]
        return thinned(Curves(_numbers(film.rollout.time), dict(zip(labels, _numbers(q.T), strict=True))))

    return curves


def thinned(curves: Curves) -> Curves:
    """At most `_POINTS` points: of each stretch of time the least and the largest value."""
    n = len(curves.time)
    if n <= _POINTS:
        return curves
    edges = np.linspace(0, n, _POINTS // 2 + 1).astype(int)
    stretches = list(itertools.pairwise(edges))
    time = np.ravel([(curves.time[a], curves.time[(a + b) // 2]) for a, b in stretches])
    lines = {name: np.ravel([(y[a:b].min(), y[a:b].max()) for a, b in stretches]) for name, y in curves.lines.items()}
    return Curves(time, lines)
