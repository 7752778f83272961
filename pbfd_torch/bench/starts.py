"""Random starts around a scene's own: what a solver meets when it is not shown the one start that it was tuned on."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.models import Setup
from pbfd_torch.terms.contact import Contact
from pbfd_torch.tree.kinematics import place, retract


def _depth(setup: Setup, q: Tensor) -> Tensor:
    """Deepest penetration [m] of any candidate, negative where nothing touches, `[worlds]`."""
    placement = place(setup.scene.articulation, q)
    depths = [term.depth(placement).amax(-1) for term in setup.scene.terms if isinstance(term, Contact)]
    return torch.stack(depths).amax(0)


def scattered(
    setup: Setup, seed: int = 0, bend: float = 0.3, speed: float = 1.0, moved: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Random starts `[worlds, nq]`, `[worlds, nv]` around the set-up's own, bent at every joint by `bend` [rad], moving at `speed`
    [rad/s, m/s] (standard deviations), and lifted until nothing touches the ground deeper than it did. moved: which degrees of
    freedom `[nv]`, as 1 and 0; None: all."""
    random = torch.Generator().manual_seed(seed)
    a = setup.scene.articulation

    def normal() -> Tensor:
        drawn = torch.randn(setup.worlds, a.nv, dtype=torch.float64, generator=random).to(setup.q.dtype)
        return drawn if moved is None else drawn * moved

    q = retract(a, setup.q, bend * normal() * a.topology.turns.to(setup.q.dtype))
    v = setup.v + speed * normal()
    if any(isinstance(term, Contact) for term in setup.scene.terms):
        axes = place(a, setup.q).axes[0]
        up = (axes[:, 5] > 0.999) & (axes[:, :3].abs().sum(-1) < 1e-6)  # the degree of freedom that lifts the whole robot
        lift = (_depth(setup, q) - _depth(setup, setup.q).clamp_min(0)).clamp_min(0)
        q = retract(a, q, lift[:, None] * up.to(q.dtype))
    return q, v
