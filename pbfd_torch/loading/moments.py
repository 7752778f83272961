"""Moments of inertia that their author has rounded to below zero."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pbfd_torch.loading.report import listing
from pbfd_torch.tree.articulation import Link

ROUNDING = 1e-6  # of the robot's largest principal moment: what files with eight digits lose, and no motion shows


def clipped_moments(links: Sequence[Link]) -> tuple[list[Link], list[str]]:
    """The links, principal moments that are below zero by at most 10⁻⁶ of the robot's largest set to zero, and a line that names
    them. What is farther below zero stays: `Articulation` refuses it."""
    matrices = np.array([link.inertia for link in links], dtype=np.float64)
    matrices = 0.5 * (matrices + matrices.swapaxes(1, 2))
    if not np.isfinite(matrices).all():
        return list(links), []
    moments, axes = np.linalg.eigh(matrices)
    least = -ROUNDING * moments.max()
    unnoticed = -1e-12 * np.abs(moments).max(1)  # of the eigenvalues themselves
    found = [k for k in range(len(links)) if min(least, unnoticed[k]) <= moments[k, 0] < unnoticed[k]]
    repaired = list(links)
    for k in found:
        (a, b, c) = ((axes[k] * np.maximum(moments[k], 0.0)) @ axes[k].T).tolist()
        repaired[k] = dataclasses.replace(links[k], inertia=((a[0], a[1], a[2]), (b[0], b[1], b[2]), (c[0], c[1], c[2])))
    if not found:
        return repaired, []
    worst = float(moments[found, 0].min())
    named = listing((links[k].name for k in found), 3)
    return repaired, [
        f"principal moments below zero by rounding, down to {worst:.2g} kg m², are set to zero ({len(found)}): {named}"
    ]
