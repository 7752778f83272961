"""What is not known of an experiment, as numbers that a fit may change: x `[*batch, n]` goes into the scene or where it starts.

Unknowns compose: each takes a case and gives the case with its numbers in it. What a reader wants to know is not always x itself:
an unknown says which physical quantities a case has of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.identify.case import Case
from pbfd_torch.identify.levenberg_marquardt import Bounds
from pbfd_torch.tree.inertial import COM, LOG_MASS, NAMES, SPREAD, log_cholesky, mass_com_inertia, pseudo_inertia_of
from pbfd_torch.tree.kinematics import retract

INERTIA = "articulation.pseudo_inertia"
MOMENTS = ((0, 0, "xx"), (1, 1, "yy"), (2, 2, "zz"), (0, 1, "xy"), (1, 2, "yz"), (0, 2, "xz"))


@dataclass(frozen=True)
class Quantity:
    """What a number means: its name and unit, for reports."""

    name: str
    unit: str = ""


class Unknown(Protocol):
    """Numbers of a case that a fit may change."""

    def start(self, case: Case) -> Tensor:
        """x `[n]` of a single case as it is."""
        ...

    def bounds(self, case: Case) -> Bounds:
        """See `Bounds`; the scale is how well x was known before."""
        ...

    def put(self, case: Case, x: Tensor) -> Case:
        """The cases with x `[*batch, n]` in them."""
        ...

    def labels(self, case: Case) -> Sequence[str]:
        """Names of the components of x."""
        ...

    def quantities(self, case: Case) -> Sequence[Quantity]:
        """What reports show of it."""
        ...

    def values(self, case: Case, x: Tensor) -> Tensor:
        """Those quantities, `[*batch, k]`, of the cases that have x in them."""
        ...


@dataclass(frozen=True)
class Parameter:
    """A number of the scene.

    Attributes:
        name, unit: for reports.
        places: names of `parameters(scene)`; all that are named get the same number, as a servo's gain and stiffness do.
        entries: which entries of them, counted in the flattened parameter; empty: all.
        lower, upper: bounds.
        scale: how well it was known before; None: to its own size.
    """

    name: str
    places: tuple[str, ...]
    entries: tuple[int, ...] = ()
    lower: float = -math.inf
    upper: float = math.inf
    scale: float | None = None
    unit: str = ""

    def start(self, case: Case) -> Tensor:
        """See `Unknown`. Raises `InputError` for a name or an entry that the scene does not have."""
        for place in self.places:
            count = case.number(place).numel()
            for entry in self.entries:
                if not 0 <= entry < count:
                    raise InputError(f"{self.name}: entry {entry} of {place}: must be ≥ 0 and < {count}")
        first = self.entries[0] if self.entries else 0
        return case.number(self.places[0]).reshape(*case.batch, -1)[..., first : first + 1]

    def bounds(self, case: Case) -> Bounds:
        """See `Unknown`. Raises `InputError` where the number is zero and no scale is given."""
        start = self.start(case)
        scale = start.abs() if self.scale is None else torch.full_like(start, self.scale)
        if not bool((scale > 0).all()):
            raise InputError(f"{self.name}: the scale is {float(scale):g}: must be > 0 (a number that is 0 needs one)")
        return Bounds(torch.full_like(start, self.lower), torch.full_like(start, self.upper), scale)

    def put(self, case: Case, x: Tensor) -> Case:
        """See `Unknown`."""
        for place in self.places:
            old = case.number(place)
            event = old.shape[len(case.batch) :]
            flat = old.reshape(*case.batch, -1)
            mask = torch.zeros(flat.shape[-1], dtype=torch.bool, device=x.device)
            mask[list(self.entries) if self.entries else slice(None)] = True
            case = case.with_number(place, torch.where(mask, x, flat).reshape((*case.batch, *event)))
        return case

    def labels(self, case: Case) -> Sequence[str]:
        """See `Unknown`."""
        return (self.name,)

    def quantities(self, case: Case) -> Sequence[Quantity]:
        """See `Unknown`."""
        return (Quantity(self.name, self.unit),)

    def values(self, case: Case, x: Tensor) -> Tensor:
        """See `Unknown`."""
        return x


@dataclass(frozen=True)
class _LogCholesky:
    """Some of the log-Cholesky parameters of a link, so that whatever a fit tries is a body. `link`: its name."""

    link: str

    def start(self, case: Case) -> Tensor:
        """See `Unknown`. Raises `InputError` for a link that there is not, or that has no mass or no extent."""
        return self._all(case)[..., self._part]

    def put(self, case: Case, x: Tensor) -> Case:
        """See `Unknown`."""
        parameters = self._all(case)
        before, after = parameters[..., : self._part.start], parameters[..., self._part.stop :]
        body = pseudo_inertia_of(torch.cat((before, x, after), -1))
        k, every = case.scene.articulation.link_index(self.link), case.number(INERTIA)
        return case.with_number(INERTIA, torch.cat((every[..., :k, :, :], body[..., None, :, :], every[..., k + 1 :, :, :]), -3))

    def _all(self, case: Case) -> Tensor:
        return log_cholesky(self._body(case))

    def _body(self, case: Case) -> Tensor:
        return case.number(INERTIA)[..., case.scene.articulation.link_index(self.link), :, :]

    @property
    def _part(self) -> slice:
        raise NotImplementedError


@dataclass(frozen=True)
class Mass(_LogCholesky):
    """The mass of a link, with its inertia in proportion. x: half of its logarithm. `factor`: up to what factor it was known
    before."""

    factor: float = 2.0

    def __post_init__(self) -> None:
        if not 1 < self.factor < math.inf:
            raise InputError(f"factor is {self.factor}: must be > 1 and finite")

    @property
    def _part(self) -> slice:
        return LOG_MASS

    def bounds(self, case: Case) -> Bounds:
        """See `Unknown`."""
        return _unbounded(torch.full_like(self.start(case), 0.5 * math.log(self.factor)))

    def labels(self, case: Case) -> Sequence[str]:
        """See `Unknown`."""
        return (f"{self.link}: mass",)

    def quantities(self, case: Case) -> Sequence[Quantity]:
        """See `Unknown`."""
        return (Quantity(f"{self.link}: mass", "kg"),)

    def values(self, case: Case, x: Tensor) -> Tensor:
        """See `Unknown`."""
        return mass_com_inertia(self._body(case))[0][..., None]


@dataclass(frozen=True)
class CenterOfMass(_LogCholesky):
    """The centre of mass of a link in the link's frame; the inertia about it stays. `distance` [m] > 0: how well it was known
    before."""

    distance: float = 0.1

    def __post_init__(self) -> None:
        if not 0 < self.distance < math.inf:
            raise InputError(f"distance is {self.distance} m: must be > 0 and finite")

    @property
    def _part(self) -> slice:
        return COM

    def bounds(self, case: Case) -> Bounds:
        """See `Unknown`."""
        return _unbounded(torch.full_like(self.start(case), self.distance))

    def labels(self, case: Case) -> Sequence[str]:
        """See `Unknown`."""
        return tuple(f"{self.link}: com {axis}" for axis in "xyz")

    def quantities(self, case: Case) -> Sequence[Quantity]:
        """See `Unknown`."""
        return tuple(Quantity(f"{self.link}: com {axis}", "m") for axis in "xyz")

    def values(self, case: Case, x: Tensor) -> Tensor:
        """See `Unknown`."""
        return mass_com_inertia(self._body(case))[1]


@dataclass(frozen=True)
class Spread(_LogCholesky):
    """How the mass of a link is spread about its centre of mass: six numbers, those of log-Cholesky. Shown as the inertia about
    it, which is in proportion to the mass."""

    @property
    def _part(self) -> slice:
        return SPREAD

    def bounds(self, case: Case) -> Bounds:
        """See `Unknown`: each radius known to a factor of 2, and products as large as the radii."""
        start = self.start(case)
        radius = start[:3].exp().mean()
        return _unbounded(torch.cat((torch.full_like(start[:3], math.log(2.0)), radius.expand(3))))

    def labels(self, case: Case) -> Sequence[str]:
        """See `Unknown`."""
        return tuple(f"{self.link}: spread {name}" for name in NAMES[SPREAD])

    def quantities(self, case: Case) -> Sequence[Quantity]:
        """See `Unknown`."""
        return tuple(Quantity(f"{self.link}: I{axes}", "kg m²") for *_, axes in MOMENTS)

    def values(self, case: Case, x: Tensor) -> Tensor:
        """See `Unknown`."""
        inertia = mass_com_inertia(self._body(case))[2]
        return torch.stack([inertia[..., i, j] for i, j, _ in MOMENTS], -1)


@dataclass(frozen=True, eq=False)
class Start:
    """Where every run starts, as a change from the case's q and v in tangent coordinates.

    `q_scale`, `v_scale`: `[nv]` > 0, how well both were known before [m, rad; m/s, rad/s]."""

    q_scale: Tensor
    v_scale: Tensor

    def start(self, case: Case) -> Tensor:
        """See `Unknown`."""
        return case.q.new_zeros(case.runs * 2 * case.scene.articulation.nv)

    def bounds(self, case: Case) -> Bounds:
        """See `Unknown`."""
        return _unbounded(torch.cat((self.q_scale, self.v_scale)).to(case.q).repeat(case.runs))

    def put(self, case: Case, x: Tensor) -> Case:
        """See `Unknown`."""
        a = case.scene.articulation
        moved, sped = x.unflatten(-1, (case.runs, 2, a.nv)).unbind(-2)
        return Case(case.scene, retract(a, case.q, moved), case.v + sped, case.batch, case.numbers)

    def labels(self, case: Case) -> Sequence[str]:
        """See `Unknown`."""
        return tuple(quantity.name for quantity in self.quantities(case))

    def quantities(self, case: Case) -> Sequence[Quantity]:
        """See `Unknown`."""
        a = case.scene.articulation
        names = [a.joint_names[j] for j in a.topology.dof_joints]
        each = [f"{what} of {name} {i - names.index(name)}" for what in ("δq", "δv") for i, name in enumerate(names)]
        return tuple(Quantity(f"run {run}: {what}") for run in range(case.runs) for what in each)

    def values(self, case: Case, x: Tensor) -> Tensor:
        """See `Unknown`."""
        return x


def _unbounded(scale: Tensor) -> Bounds:
    return Bounds(torch.full_like(scale, -math.inf), torch.full_like(scale, math.inf), scale)
