"""System identification: the numbers of a scene that make a simulation repeat an experiment, and how well it tells them.

The residual of all samples is minimised by Levenberg–Marquardt. Its Jacobian is exact, by forward derivatives through the
simulator: every column is a world more in the batch, so all columns, runs, starts and data sets are one rollout.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.implicit import Doubtful, Gradients
from pbfd_torch.identify.case import Case
from pbfd_torch.identify.certainty import Certainty, certainty
from pbfd_torch.identify.columns import linearized
from pbfd_torch.identify.levenberg_marquardt import Bounds, Fit, Stopping, levenberg_marquardt
from pbfd_torch.identify.measurements import Measurement
from pbfd_torch.identify.unknowns import Quantity, Unknown
from pbfd_torch.integrators.integrator import Integrator, State
from pbfd_torch.simulator import Simulator


@dataclass(frozen=True, eq=False)
class Experiment:
    """Some runs of the real thing.

    Attributes:
        case: what they set out from, as far as it is known.
        measured: what was measured of them.
        dt: step of the simulation [s]; there is a sample after each.
        controls: `[steps, runs, nu]`, known; None: zero.
        integrator: of the simulation; None: the default.
    """

    case: Case
    measured: Measurement
    dt: float
    controls: Tensor | None = None
    integrator: Integrator[State] | None = None

    def __post_init__(self) -> None:
        expected = (self.measured.steps, self.case.runs, self.case.scene.nu)
        if self.controls is not None and tuple(self.controls.shape) != expected:
            raise InputError(f"controls have shape {tuple(self.controls.shape)}: must be {list(expected)}")

    def first(self, steps: int) -> Experiment:
        """The same runs, ended early."""
        if not 1 <= steps <= self.measured.steps:
            raise InputError(f"steps is {steps}: must be ≥ 1 and ≤ {self.measured.steps}")
        controls = None if self.controls is None else self.controls[:steps]
        return dataclasses.replace(self, measured=self.measured.first(steps), controls=controls)

    def simulated(self, case: Case) -> tuple[Tensor, Tensor]:
        """q `[steps, *batch, runs, nq]` of the simulation of cases, and how many steps were unsolved, `[*batch]`."""
        # a start from which a fit is far off may not be solvable: then the fit looks elsewhere
        simulator: Simulator[State] = Simulator(
            case.world_scene, self.dt, self.integrator, gradients=Gradients(doubtful=Doubtful.ZERO)
        )
        controls = self.controls
        if controls is not None:
            shape = controls.shape
            controls = controls.reshape(shape[0], *(1,) * len(case.batch), *shape[1:]).expand(-1, *case.batch, -1, -1).contiguous()
        made = simulator.trajectory(
            simulator.initial_state(case.q.contiguous(), case.v.contiguous()), controls, steps=self.measured.steps
        )
        return made.q[1:], (~made.solved).sum((0, -1))


@dataclass(frozen=True)
class Prior:
    """What was known of an unknown before: x is normal about its start with these standard deviations, `[n]` or one."""

    unknown: Unknown
    deviation: float | Tensor


@dataclass(frozen=True, eq=False)
class Identification:
    """Which unknowns of an experiment are looked for. `priors`: about some of them."""

    experiment: Experiment
    unknowns: Sequence[Unknown]
    priors: Sequence[Prior] = ()

    def __post_init__(self) -> None:
        if not self.unknowns:
            raise InputError("there are no unknowns: give at least one")
        for prior in self.priors:
            if prior.unknown not in self.unknowns:
                raise InputError(f"a prior is about {prior.unknown}, which is none of the unknowns")

    @property
    def start(self) -> Tensor:
        """x `[n]` of the experiment's case."""
        return torch.cat([unknown.start(self.experiment.case) for unknown in self.unknowns])

    @property
    def bounds(self) -> Bounds:
        """Of all unknowns."""
        each = [unknown.bounds(self.experiment.case) for unknown in self.unknowns]
        return Bounds(torch.cat([b.lower for b in each]), torch.cat([b.upper for b in each]), torch.cat([b.scale for b in each]))

    @property
    def labels(self) -> list[str]:
        """Names of the components of x."""
        return [label for unknown in self.unknowns for label in unknown.labels(self.experiment.case)]

    @property
    def quantities(self) -> list[Quantity]:
        """What reports show."""
        return [quantity for unknown in self.unknowns for quantity in unknown.quantities(self.experiment.case)]

    def first(self, steps: int) -> Identification:
        """The same from the first steps of the runs only: what happens early decides less, but its fit finds its way from afar."""
        return dataclasses.replace(self, experiment=self.experiment.first(steps))

    def case(self, x: Tensor) -> Case:
        """The experiment's case with x `[*batch, n]` in it."""
        case = self.experiment.case.repeated(*x.shape[:-1])
        for unknown, part in zip(self.unknowns, self._parts(x), strict=True):
            case = unknown.put(case, part)
        return case

    def values(self, x: Tensor) -> Tensor:
        """The quantities `[*batch, k]` of x `[*batch, n]`."""
        case = self.case(x)
        return torch.cat([u.values(case, part) for u, part in zip(self.unknowns, self._parts(x), strict=True)], -1)

    def residual(self, x: Tensor) -> Tensor:
        """Of x `[*batch, n]`, in standard deviations: samples of all runs, and priors `[*batch, m]`."""
        q, _ = self.experiment.simulated(self.case(x))
        rows = self.experiment.measured.residual(self.experiment.case.scene.articulation, q)
        # [samples, *batch, runs, k] → [*batch, samples · runs · k]
        gaps = rows.movedim(0, -3).flatten(-3)
        return torch.cat((gaps, *self._prior_gaps(x)), -1)

    def linearized(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The residual `[*batch, m]` of x `[*batch, n]` and its Jacobian `[*batch, m, n]`."""
        return linearized(self.residual)(x)

    def fit(
        self,
        starts: Tensor | None = None,
        horizons: Sequence[int] = (),
        stopping: Stopping | None = None,
        progress: bool = False,
    ) -> Identified:
        """Fits from `starts` `[*batch, n]` (None: the case as it is). horizons: numbers of steps of shorter fits made first, each
        from where the one before ended. progress: a bar on standard error."""
        x = self.start if starts is None else starts
        stopping = stopping or Stopping()
        fits: list[Fit] = []
        for stage in [*(self.first(steps) for steps in horizons), self]:
            fits.append(stage._fitted(x, stopping, progress))
            x = fits[-1].x
        return Identified(self, fits[-1], tuple(fits[:-1]))

    def _fitted(self, x: Tensor, stopping: Stopping, progress: bool) -> Fit:
        with tqdm(total=stopping.iterations, desc=f"{self.experiment.measured.steps} steps", disable=not progress) as bar:

            def told(_: int, cost: float) -> None:
                bar.set_postfix_str(f"½‖r‖² = {cost:.6g}", refresh=False)
                bar.update()

            return levenberg_marquardt(self.linearized, x, self.bounds, stopping, told)

    def _parts(self, x: Tensor) -> tuple[Tensor, ...]:
        return x.split([len(unknown.start(self.experiment.case)) for unknown in self.unknowns], -1)

    def _prior_gaps(self, x: Tensor) -> list[Tensor]:
        parts = self._parts(x)
        gaps = []
        for prior in self.priors:
            k = list(self.unknowns).index(prior.unknown)
            gaps.append((parts[k] - prior.unknown.start(self.experiment.case)) / prior.deviation)
        return gaps


def variances(fit: Fit) -> Tensor:
    """‖r‖²/(m − n) at the start and after every iteration, `[k, *batch]`."""
    rows, columns = fit.jacobian.shape[-2:]
    return 2 * fit.history / max(rows - columns, 1)


@dataclass(frozen=True, eq=False)
class Identified:
    """A finished identification of a batch of starts or of data sets. `before`: the fits of shorter horizons that led to `fit`."""

    identification: Identification
    fit: Fit
    before: tuple[Fit, ...] = ()

    @property
    def values(self) -> Tensor:
        """The quantities found, `[*batch, k]`."""
        return self.identification.values(self.fit.x)

    @property
    def variance(self) -> Tensor:
        """‖r‖²/(m − n) `[*batch]`: 1 where simulation and noise are as they were said to be."""
        return variances(self.fit)[-1]

    @property
    def unsolved(self) -> Tensor:
        """How many steps of the simulation at the answer were not solved, of all runs, `[*batch]`: derivatives end there."""
        return self.identification.experiment.simulated(self.identification.case(self.fit.x))[1]

    @property
    def best(self) -> Identified:
        """The fit of the lowest cost, as one that is no batch."""
        fit = self.fit
        count = fit.x.ndim - 1
        if count == 0:
            return self
        return self[int(fit.cost.reshape(-1).nan_to_num(torch.inf).argmin())]

    def __getitem__(self, k: int) -> Identified:
        """One fit of a flattened batch."""
        fit, last = self.fit, self.fit.x.ndim - 2
        return Identified(
            self.identification,
            Fit(
                x=fit.x.flatten(0, last)[k],
                residual=fit.residual.flatten(0, last)[k],
                jacobian=fit.jacobian.flatten(0, last)[k],
                held=fit.held.flatten(0, last)[k],
                outcome=fit.outcome.flatten()[k],
                history=fit.history.flatten(1)[:, k],
            ),
            self.before,
        )

    @property
    def certainty(self) -> Certainty:
        """Of the quantities; for a single fit."""
        fit, identification = self.fit, self.identification
        slopes = torch.func.jacfwd(identification.values)(fit.x)
        # the noise is what the fit says it is; what is determined is judged by what it was said to be, if that is more
        return certainty(fit.jacobian, self.variance, identification.bounds.scale, slopes, fit.held, stated=1.0)
