"""A T-shaped body that tumbles about its middle axis: the Dzhanibekov effect."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from pbfd_torch.contact.shapes import Box
from pbfd_torch.looks.appearance import Visual
from pbfd_torch.looks.painting import link_color, visual_of
from pbfd_torch.models.setup import Metric, Setup, repeated
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link


def _bar(mass: float, half: tuple[float, float, float], x: float) -> torch.Tensor:
    """Inertia about the origin of a box of uniform density centred at (x, 0, 0)."""
    h, c = torch.tensor(half, dtype=torch.float64), torch.tensor((x, 0.0, 0.0), dtype=torch.float64)
    second = mass * (torch.diag(h * h) / 3 + torch.outer(c, c))
    return torch.trace(second) * torch.eye(3, dtype=torch.float64) - second


def bar_visuals() -> list[Visual]:
    """The two bars in the body's axes: its x is that of the bar across, its y that of the bar along."""
    across, along, straight = Box((0.3, 0.05, 0.05)), Box((0.05, 0.15, 0.05)), (1.0, 0.0, 0.0, 0.0)
    return [
        visual_of("across", 0, across, (0.0, -0.1, 0.0), straight, link_color(0)),
        visual_of("along", 0, along, (0.0, 0.1, 0.0), straight, link_color(1)),
    ]


def dzhanibekov(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Two bars in the shape of a T, 20 rad/s about the middle axis with a small disturbance, no gravity."""
    mass = 0.5
    across, along = (0.05, 0.3, 0.05), (0.15, 0.05, 0.05)
    inertia = _bar(mass, across, -0.1) + _bar(mass, along, 0.1)
    # the body's axes are its principal axes in rising order, so that y is the middle one
    first, middle, last = torch.linalg.eigvalsh(inertia).tolist()
    rows = ((first, 0.0, 0.0), (0.0, middle, 0.0), (0.0, 0.0, last))
    link = Link("body", joints=(Joint("free", JointKind.FREE),), mass=2 * mass, inertia=rows)
    articulation = Articulation.from_links([link], dtype, device)
    scene = Scene(articulation, (Inertia(),), torch.zeros(3, dtype=dtype, device=device), name="dzhanibekov", visuals=bar_visuals)
    q = repeated(articulation.rest, worlds)
    v = q.new_zeros(worlds, 6)
    v[:, 3], v[:, 4] = 0.01, 20.0

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        spin = (
            rollout.link_poses[:, 0, 0, :, 1]
            @ rollout.angular_momentum[0, 0]
            / torch.linalg.vector_norm(rollout.angular_momentum[0, 0])
        )
        linear, angular = rollout.linear_momentum, rollout.angular_momentum
        flips = int(((spin[1:] > 0) != (spin[:-1] > 0)).sum())
        return {
            "flips": float(flips),
            "angular_momentum_drift": float((angular - angular[:1]).abs().max() / angular[0].abs().max()),
            "linear_momentum_drift_kg_m_s": float((linear - linear[:1]).abs().max()),
            "energy_drift": float(rollout.kinetic_energy[-1, 0] / rollout.kinetic_energy[0, 0] - 1),
        }

    return Setup(scene, q, v, 10.0, 1 / 240, report)
