"""The laws of contact, whatever the candidates are: how hard they push, hold and throw back, and how a step with them begins."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import torch
from torch import Tensor

from pbfd_torch.contact.hazards import Hazard, marked
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.friction_law import ByDepth, FrictionLaw
from pbfd_torch.terms.lagged_friction import lagged_law, unlagged, widened_law
from pbfd_torch.terms.load import StepContext
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.terms.touching import ContactForce, Touching
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Placement


@dataclass(frozen=True, eq=False, kw_only=True)
class Prepared:
    """What the laws need to know of a step.

    Attributes: `dt` `[*batch, 1]` [s]; `grip` `[*, n]`, see `ContactForce`; `firm` `[*, n]`: what C⊥ is multiplied by; None: 1;
    `deep` `[*, n]` [m]: from which depth on it is a hazard; None: none is; `depth` `[*batch, n]` [m] at the start of the step,
    where the normal force lets go; `bounce` `[*batch, n]` [m]: how far the solids are moved out to throw a candidate back."""

    dt: Tensor
    grip: Tensor | None
    firm: Tensor | None = None
    deep: Tensor | None = None
    depth: Tensor | None = None
    bounce: Tensor | None = None

    def raised(self, depth: Tensor) -> Tensor:
        """Depths beside the solids where these are moved to, `[*batch, n]` [m]."""
        return depth if self.bounce is None else depth + self.bounce


P = TypeVar("P", bound=Prepared)


@dataclass(frozen=True, eq=False)
class ContactPoints:
    """What the contacts of one placement look like, for records and pictures.

    Attributes: `point` `[*, n, 3]` where the force acts [m]; `depth` `[*, n]` > 0 inside the obstacle [m]; `normal` `[*, n, 3]`;
    `force` `[*, n, 3]` on the body [N]; `slip` `[*, n, 3]` over the step [m]."""

    point: Tensor
    depth: Tensor
    normal: Tensor
    force: Tensor
    slip: Tensor


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactLaws(ABC, Generic[P]):
    """A term of contact candidates.

    Attributes:
        normal_force: Eq. 8.
        friction: the tangential law, or None for frictionless contacts.
        restitution: how much of the speed of an impact comes back; None: nothing.
        firm: what C⊥ is multiplied by, `[*, n]` for as many candidates or pairs as `grip` has; None: 1.
        deep: from which depth on [m] it is a hazard, likewise; None: none is.
        pairs: names of the two that touch, of every candidate or pair.
    """

    normal_force: NormalForce
    friction: FrictionLaw | None
    restitution: Restitution | None = None
    firm: Tensor | None = None
    deep: Tensor | None = None
    pairs: tuple[tuple[str, str], ...] = ()

    @abstractmethod
    def memory(self, batch: tuple[int, ...]) -> Tensor:
        """See `Remembering`: what the anchors know at a fresh start."""

    @abstractmethod
    def recall(self, step: StepContext, memory: Tensor) -> P:
        """`prepare` with what the anchors knew at the end of the last step."""

    @abstractmethod
    def touching(self, prepared: P, placement: Placement) -> Touching:
        """Where the candidates are at a placement that ends the prepared step."""

    @abstractmethod
    def depths(self, prepared: P, placement: Placement) -> Tensor:
        """How deep the candidates are at a placement that ends the prepared step, < 0 where apart, `[*batch, n]` [m]."""

    @abstractmethod
    def carried(self, prepared: P, links: Tensor) -> Tensor:
        """Which candidates belong to some of the links, `[*batch, nlink]` → `[*batch, n]`, both bool."""

    def hazards(self, prepared: P, placement: Placement, turned: Tensor) -> Tensor:
        """See `Hazardous`."""
        depth = self.depths(prepared, placement)
        far = (depth > 0) & self.carried(prepared, turned)
        found = {Hazard.TURNED_FAR: far.any(-1)}
        if prepared.deep is not None:
            found[Hazard.TOO_DEEP] = (depth > prepared.deep).any(-1)
        return marked(found)

    def dangers(self, articulation: Articulation) -> tuple[str, ...]:
        """See `Hazardous`."""
        return tuple(" – ".join(pair) for pair in self.pairs)

    @abstractmethod
    def numbers(self, prepared: P) -> Tensor:
        """The place of each candidate among `pairs`, `[*batch, n]` or `[n]`."""

    def strain(self, prepared: P, placement: Placement, turned: Tensor) -> tuple[Tensor, Tensor]:
        """See `Hazardous`."""
        depth = self.depths(prepared, placement)
        share = torch.zeros_like(depth) if prepared.deep is None else depth / prepared.deep
        share = share + ((depth > 0) & self.carried(prepared, turned))
        return share, self.numbers(prepared).expand(depth.shape)

    def prepare(self, step: StepContext) -> P:
        """See `Term`."""
        return self.recall(step, self.memory(step.target_q.shape[:-1]))

    @property
    def _anchors(self) -> AnchoredFriction | None:
        """The friction, if it remembers where contacts stuck."""
        return self.friction if isinstance(self.friction, AnchoredFriction) else None

    def _gripping(self, grip: Tensor | None, firm: Tensor | None) -> Tensor | None:
        """What the friction law is multiplied by: a law that goes by the depth is made as firm as the normal force, `[*, n]`."""
        if firm is None or not isinstance(unlagged(self.friction), ByDepth):
            return grip
        return firm if grip is None else firm * grip

    def _beginning(
        self,
        dt: Tensor,
        start: Callable[[], Tensor],
        free: Callable[[], Tensor],
        coasting: Callable[[], Tensor],
    ) -> tuple[Tensor | None, Tensor | None]:
        """`depth` and `bounce` of `Prepared`, from the gaps `[*batch, n]` [m] at the start of the step, at the end of its
        free motion, and at that without any force; they are asked for where they count."""
        lets_go = math.isfinite(self.normal_force.release)
        if self.restitution is None and not lets_go:
            return None, None
        gap = start()
        bounce = None if self.restitution is None else self.restitution.bounce(gap, free(), dt, coasting())
        return -gap if lets_go else None, bounce

    def take(self, worlds: Worlds) -> Self:
        """The same contact of some worlds."""
        friction = None if self.friction is None else self.friction.take(worlds)
        firm, deep = worlds.pick(self.firm, 1), worlds.pick(self.deep, 1)
        return replaced(self, normal_force=self.normal_force.take(worlds), friction=friction, firm=firm, deep=deep)

    def pressing(self, prepared: P) -> NormalForce:
        """The normal force of every candidate in the prepared step."""
        law = self.normal_force
        if prepared.firm is not None:
            law = replaced(law, stiffness=law.stiffness * prepared.firm)
        if self.restitution is None or prepared.bounce is None:
            return law
        return self.restitution.stiffened(law, prepared.bounce)

    def force(self, prepared: P, placement: Placement) -> ContactForce:
        """The forces on the candidates at a placement that ends the prepared step."""
        during = self.pressing(prepared).during(prepared.depth, prepared.dt)
        return ContactForce(self.touching(prepared, placement), during, self.friction, prepared.dt, prepared.grip)

    def points(self, prepared: P, placement: Placement) -> ContactPoints:
        """The contacts at a placement that ends the prepared step."""
        contact = self.force(prepared, placement)
        at = contact.at
        return ContactPoints(at.points, at.depth, at.normal, contact.force, at.slip)

    def push(self, prepared: P, placement: Placement) -> Tensor:
        """See `Pushing`."""
        return self.force(prepared, placement).push.sum(-1)

    def energy(self, prepared: P, placement: Placement) -> Tensor:
        """Stored energy (Eq. 9) and, where the friction is lagged, its energy μ N̂ S(‖u‖) [J] `[*batch]`. Friction that follows
        the normal force is the gradient of no scalar: it has no part in this."""
        return self.force(prepared, placement).energy().sum(-1)

    def lagged(self, prepared: P, placement: Placement) -> Self:
        """The same contact with its friction held at the normal forces and depths of `placement`; without friction, or with a law
        that is no `SlipLaw`, the contact itself. What `softened` does later to C⊥ does not reach the held friction.

        The load is then the gradient of `energy`, exactly for points on flat solids. For rounded candidates it is not: friction f
        acts at c − ρn, which moves by δc − ρ δω × n, while the slip takes φ and moves by δc − ρ (Lδω) × n with L = ∂φ/∂ω. The
        gradient has the moment ρ (Lᵀ − 1)(n × f) more than the load, about ½ρ‖φ‖‖f‖ at most, and none where φ is along n × f
        (planar rolling)."""
        contact = self.force(prepared, placement)
        return replaced(self, friction=lagged_law(self.friction, contact.push, contact.at.depth))

    def widened(self, factor: float) -> Self:
        """The same contact with its friction smooth over a `factor` ≥ 1 times wider range of slip speeds, where the law has one."""
        return replaced(self, friction=widened_law(self.friction, factor))

    def seen_from(self, distance: float) -> Self:
        """See `Foreboding`."""
        return replaced(self, normal_force=self.normal_force.seen_from(distance))

    def softened(self, factor: float) -> Self:
        """The same contact with C⊥ scaled by `factor`; the friction law follows the normal force."""
        return replaced(self, normal_force=self.normal_force.scaled(factor))
