"""What a direction promises: the work of the forces along it, without walking through the tree again.

Along q ⊕ a·d contacts see their points move on parabolas, joints see their coordinates move, and what is smooth is taken to change
linearly. So a search can look at many lengths at once, sees where something touches or begins to slip, and pays for neither
kinematics nor Jacobians.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.terms.load import ChordLoad, JointLoad, LinkLoad, Term
from pbfd_torch.tree.kinematics import Motion, Placement, retract


class Outlook:
    """The estimated work φ(a) = r·d [J] of terms, with what each of them prepared, from their balance along a direction d
    `[*batch, nv]`."""

    def __init__(self, terms: Sequence[Term], prepared: Sequence[Any], balance: Balance, direction: Tensor) -> None:
        self._motion = Motion(balance.placement, direction)
        self._constant, self._slope = torch.zeros_like(direction[..., 0]), torch.zeros_like(direction[..., 0])
        self._foretold: list[Callable[[Tensor], Tensor]] = []
        self._on_joints: list[tuple[Term, Any]] = []
        for term, fixed, load in zip(terms, prepared, balance.loads, strict=True):
            if isinstance(load, ChordLoad):
                continue
            if not isinstance(load, LinkLoad):
                self._on_joints.append((term, fixed))
            elif load.outlook is None:
                self._add_linear(load)
            else:
                self._foretold.append(load.outlook(self._motion))
        for chord in balance.chords:
            answer = ((chord.stiffness + chord.curvature) * direction[..., None, :]).sum(-1)
            self._constant = self._constant + (chord.residual * direction).sum(-1)
            self._slope = self._slope + (answer * direction).sum(-1)

    def _add_linear(self, load: LinkLoad) -> None:
        """⟨M, [V]⟩ and its change V·A V + ⟨M, [V̇] + [V]²⟩, M the moment and A the stiffness."""
        answer = (load.stiffness * self._motion.twists[..., None, :]).sum(-1)
        if load.coupled:
            answer = answer + (load.coupling * self._motion.twists[..., None, :, None, :]).sum((-3, -1))
        change = (load.moment * self._motion.changes).sum((-3, -2, -1))
        self._constant = self._constant + (load.moment * self._motion.velocities).sum((-3, -2, -1))
        self._slope = self._slope + (answer * self._motion.twists).sum((-2, -1)) + change

    def __call__(self, length: Tensor) -> Tensor:
        """φ `[k, *batch]` at lengths a `[k, *batch]`."""
        work = self._constant + length * self._slope
        for of_term in self._foretold:
            work = work + of_term(length)
        if self._on_joints:
            work = work + self._of_joints(length)
        return work

    def _of_joints(self, length: Tensor) -> Tensor:
        at, d = self._motion.placement, self._motion.v
        # loads on joints ask for the joints' coordinates only
        moved = Placement(at.articulation, retract(at.articulation, at.q, length[..., None] * d), at.nodes, at.poses)
        work = torch.zeros_like(length)
        for term, fixed in self._on_joints:
            load = term.load(fixed, moved)
            if isinstance(load, JointLoad):
                work = work + (load.residual * d).sum(-1)
        return work
