"""Laws of contact as the C++ core sees them: numbers in the order in which src/laws.h reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.native.not_compiled import unknown
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact_laws import ContactLaws
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbd_friction import PbdFriction
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.terms.static_friction import StaticFriction
from pbfd_torch.terms.torsional_friction import TorsionalFriction
from pbfd_torch.tree.articulation import Articulation

COULOMB, STATIC, PAPER, GRADIENT = range(4)  # anchored friction is Coulomb's with a memory
PATCH = 7  # which of the particulars ℓμ is
CONSTANT = (0, 1, 2, 5, 6)  # which of them the core has no derivatives by: exponents, and restitution
USUAL = -1  # the law C d² with Coulomb's friction, of which most contacts are: it has no row


@dataclass
class Laws:
    """The other ones, of a candidate or of a pair each: its manner, and α, e, γ, μ_s − μ_k, 1/v_s [s/m], the restitution (0: none)
    and its threshold [m/s], ℓμ of torsional friction [m] (0: none) and 1/ε_ω [s/rad], `[*, 1]` each."""

    manners: list[int] = field(default_factory=list)
    rows: list[Sequence[Tensor]] = field(default_factory=list)

    def real(self) -> Sequence[Tensor]:
        """The numbers."""
        return [x for row in self.rows for x in row]

    @property
    def constants(self) -> list[Tensor]:
        """Those that the core has no derivatives by."""
        return [row[k] for row in self.rows for k in CONSTANT]

    def number(self, law: Law, i: int) -> int:
        """Adds that of one of the candidates or pairs of a contact; its number."""
        row = [x[..., i, None] for x in law.particulars]
        if law.usual and not bool((row[PATCH] > 0).any()):
            return USUAL
        self.manners.append(law.manner)
        self.rows.append(row)
        return len(self.manners) - 1


@dataclass(frozen=True, eq=False)
class Law:
    """That of a contact of n candidates or pairs.

    Attributes:
        manner: of its friction. particulars: `[*, n]` each, see `Laws`. usual: whether nothing is particular about it but torsional
            friction.
        numbers: C⊥, μ or what friction that goes by the depth has in its place, from which depth on it is a hazard [m], one over
            the release speed [s/m] and one over what friction is smooth below, a slip speed [s/m] or the stretch of an anchor
            [1/m], `[*, n]` each.
    """

    manner: int
    particulars: Sequence[Tensor]
    usual: bool
    numbers: Sequence[Tensor]

    @classmethod
    def of(cls, a: Articulation, term: ContactLaws[Any], name: str, count: int, torsion: TorsionalFriction | None = None) -> Law:
        """Of a term, and of its torsional friction. Raises `NotCompiledError` for laws that the core does not know."""
        law, firm, back = term.normal_force, term.firm, term.restitution
        if type(law) is not NormalForce:
            raise unknown(f"normal force on {name}, a {type(law).__name__}")

        def each(value: float | Tensor | None, other: float = 0.0) -> Tensor:
            number = torch.as_tensor(other if value is None else value, dtype=a.dtype)
            return number.expand(*number.shape[:-1], count)

        grip = each(getattr(term, "grip", None), 1.0)
        friction = _Friction.of(term.friction)
        mu = each(friction.mu) * grip
        numbers = (
            each(law.stiffness) * each(firm, 1.0),
            mu * each(firm, 1.0) if friction.manner >= PAPER else mu,
            each(term.deep, torch.finfo(a.dtype).max),
            1.0 / each(law.release),
            1.0 / each(friction.width),
        )
        particulars = (
            each(law.exponent),
            each(friction.slip),
            each(friction.sunk),
            each(friction.excess) * grip,
            each(friction.per_fall),
            each(0.0 if back is None else back.coefficient),
            each(0.0 if back is None else back.threshold),
            each(None if torsion is None else torsion.arm),
            each(1.0 if torsion is None else 1.0 / torsion.spin_speed),
        )
        usual = friction.manner == COULOMB and law.exponent == 2.0 and back is None
        return cls(friction.manner, particulars, usual, numbers)


@dataclass(frozen=True, eq=False)
class _Friction:
    """A friction law as src/laws.h has it, see `Laws`; width: what it is smooth below, a slip speed [m/s] or a stretch [m]."""

    manner: int = COULOMB
    mu: float | Tensor = 0.0
    width: float = 1.0
    slip: float = 0.0
    sunk: float = 0.0
    excess: float | Tensor = 0.0
    per_fall: float = 0.0

    @classmethod
    def of(cls, law: FrictionLaw | None) -> _Friction:
        """Raises `NotCompiledError` for other laws."""
        known: Any = law
        if law is None:
            return cls()
        if type(known) is CoulombFriction:
            return cls(COULOMB, known.mu, known.slip_speed)
        if type(known) is AnchoredFriction:
            return cls(COULOMB, known.mu, known.stretch)
        if type(known) is StaticFriction:
            excess = known.mu_static - known.mu_kinetic
            return cls(STATIC, known.mu_kinetic, known.slip_speed, excess=excess, per_fall=1.0 / known.stribeck_speed)
        if type(known) is PbfdFriction:
            return cls(PAPER, (known.beta + 1) * known.stiffness, slip=known.slip_exponent, sunk=known.gamma)
        if type(known) is PbdFriction:
            return cls(GRADIENT, (known.beta + 1) * known.stiffness, slip=known.beta - 1, sunk=known.gamma)
        raise unknown(type(law).__name__)
