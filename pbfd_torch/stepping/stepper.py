"""What makes steps: the one place that says what every engine has in common.

A stepper is made of a scene, an integrator, a step size, a solver and how often a world's step may be halved. It makes one step of
all worlds at once, without derivatives. What is done with steps is built on it: derivatives retrace them (`gradients`), schedules
decide which worlds make which steps when (`schedules`), and `Simulator` is the face of it all. `EagerStepper` is the definition,
in PyTorch; another engine makes the same steps and is judged by that one.
"""

from __future__ import annotations

from typing import Protocol, Self

from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.integrators.integrator import Integrator, S
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.objective import Relaxable, Solution
from pbfd_torch.stepping.way import Way
from pbfd_torch.tensors.worlds import Worlds

SHORTEST_STEP, LONGEST_STEP = 1e-5, 100.0  # [s]


class Solver(Protocol):
    """What finds the end of a step."""

    def solve(self, objective: Relaxable, guess: Tensor, retreat: Tensor | None = None) -> Solution:
        """Root of the objective for every world, from `guess`, or from `retreat` where that is the safer start."""
        ...


class Stepper(Protocol[S]):
    """One step of all worlds, without derivatives."""

    @property
    def scene(self) -> Scene:
        """What moves, and all that acts on it."""
        ...

    @property
    def integrator(self) -> Integrator[S]:
        """The scheme that says what a step is."""
        ...

    @property
    def step_size(self) -> Tensor:
        """Δt [s] `[]`, or that of each world `[*batch]`."""
        ...

    @property
    def dt(self) -> float:
        """Δt [s] as a number, the shortest of all worlds."""
        ...

    @property
    def solver(self) -> Solver:
        """What finds the end of a step."""
        ...

    @property
    def halvings(self) -> int:
        """How often a world's step may be halved (2, 4, 8 … shorter steps) where nothing else solves it."""
        ...

    def initial_state(self, q: Tensor, v: Tensor, control: Tensor | None) -> S:
        """State at configuration q `[*batch, nq]` and velocity v `[*batch, nv]`, which `Scene.placed` has checked, under a control
        `[*batch, nu]` (None: zero)."""
        ...

    def made(self, state: S, control: Tensor | None) -> tuple[S, Solution, Way]:
        """A step of all worlds under a control `[*batch, nu]` (None: zero): the state after it, how it was solved, and how it was
        made. Never raises for one bad world; an unsolved one goes on from the best point found."""
        ...

    def objective(self, state: S, control: Tensor | None) -> BalanceObjective:
        """The balance of forces that the step from `state` solves."""
        ...

    def take(self, worlds: Worlds) -> Self:
        """The stepper of some worlds."""
        ...

    def sized(self, step_size: Tensor) -> Stepper[S]:
        """The same with steps [s] of another length `[]`, or of one for each world `[*batch]`."""
        ...
