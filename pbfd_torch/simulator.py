"""The simulator: the face of a stepper, with all that is done with steps, for any batch of worlds at once."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, Generic, Self

import torch
from torch import Tensor

from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.checked import Array
from pbfd_torch.errors import InputError
from pbfd_torch.gradients.implicit import Gradients
from pbfd_torch.gradients.linearization import Linearization, linearized
from pbfd_torch.gradients.linked import Linked
from pbfd_torch.gradients.parts import Carriers
from pbfd_torch.gradients.trajectory import Trajectory, trajectory
from pbfd_torch.gradients.walks import stepped
from pbfd_torch.integrators.integrator import Integrator, Leaping, S
from pbfd_torch.integrators.runge_kutta import RungeKutta
from pbfd_torch.native.engine import Engine, chosen
from pbfd_torch.native.rollout import rolled_out as many_rolled_out
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.schedules.adaptive import AdaptiveStepper
from pbfd_torch.schedules.events import EventStepper, made_with_events
from pbfd_torch.schedules.lock_step import rolled_out
from pbfd_torch.solvers.objective import Solution
from pbfd_torch.stepping.accuracy import Accuracy
from pbfd_torch.stepping.eager import MOST_EVALUATIONS, EagerStepper
from pbfd_torch.stepping.stepper import Solver, Stepper
from pbfd_torch.tree.articulation import Articulation


class Simulator(Generic[S]):
    """Steps a scene.

    `dt`: step [s] from 1e-5 to 100, a number, or a scalar tensor where gradients by it are wanted; in shorter ones rounding would
    dominate the positions' differences. `halvings`: how often a world's step may be halved (2, 4, 8 … shorter steps) where
    nothing else solves it; 0: never. `evaluations`: the most that a world may spend on a step, with all that is tried; what is not
    solved by then is unsolved. `gradients`: how steps are differentiated (`gradients.implicit`).

    `engine`: what makes the steps (`native.engine`): `Native()`, the compiled core, or `Torch()`; None: the core where it covers
    them, else PyTorch, and `engine_reason` says why. Raises `InputError` where the core is asked for and cannot.

    `stepper` makes the steps. `eager` makes them in PyTorch: it knows their balance, and derivatives retrace them with it."""

    def __init__(
        self,
        scene: Scene,
        dt: float | Tensor,
        integrator: Integrator[S] | None = None,
        solver: Solver | None = None,
        halvings: int = 3,
        gradients: Gradients | None = None,
        evaluations: int = MOST_EVALUATIONS,
        engine: Engine | None = None,
    ) -> None:
        self.eager: EagerStepper[S] = EagerStepper(scene, dt, integrator, solver, halvings, evaluations)
        self.gradients = gradients or Gradients()
        self._engine = engine
        self._made: tuple[Stepper[S], str, str] | None = None  # the stepper, its engine, and why it is no other; when asked for
        self._carrying: Carriers | None = None  # when asked for
        if engine is not None:
            self._stepping()

    def _stepping(self) -> tuple[Stepper[S], str, str]:
        if self._made is None:
            self._made = self._engined(self.eager)
        return self._made

    def _engined(self, eager: EagerStepper[Any]) -> tuple[Stepper[Any], str, str]:
        """What the engine makes of a stepper: see `_made`."""
        return chosen(eager) if self._engine is None else (self._engine.stepper(eager), self._engine.name, "")

    def _maker(self, eager: EagerStepper[Any]) -> Stepper[Any]:
        """What makes the steps of a stepper such as this one's."""
        if eager is self.eager:
            return self.stepper
        return self._engined(eager)[0]

    def _carriers(self) -> Carriers:
        if self._carrying is None:
            self._carrying = Carriers(self.eager)
        return self._carrying

    @property
    def stepper(self) -> Stepper[S]:
        """What makes the steps."""
        return self._stepping()[0]

    @property
    def engine(self) -> str:
        """The name of the engine that makes the steps: `native` or `torch`."""
        return self._stepping()[1]

    @property
    def engine_reason(self) -> str:
        """Why the steps are not compiled, in words; empty where they are, or where the engine was asked for."""
        return self._stepping()[2]

    @property
    def scene(self) -> Scene:
        """What moves, and all that acts on it."""
        return self.eager.scene

    @property
    def articulation(self) -> Articulation:
        """The scene's bodies."""
        return self.eager.scene.articulation

    @property
    def integrator(self) -> Integrator[S]:
        """The scheme that says what a step is."""
        return self.eager.integrator

    @property
    def solver(self) -> Solver:
        """What finds the end of a step."""
        return self.eager.solver

    @property
    def halvings(self) -> int:
        """How often a world's step may be halved."""
        return self.eager.halvings

    @property
    def dt(self) -> float:
        """The step [s]."""
        return self.eager.dt

    @property
    def step_size(self) -> Tensor:
        """The step [s] as a tensor, which may carry derivatives."""
        return self.eager.step_size

    @property
    def roller(self) -> Callable[..., Rollout]:
        """What makes rollouts, of the stepper and of others like it: a function that takes it first, and then what `rollout`
        takes."""
        return many_rolled_out if isinstance(self.stepper, NativeStepper) else rolled_out

    def sized(self, step_size: Tensor) -> Self:
        """The same simulator with steps [s] of another length `[]`, or of one for each world `[*batch]`."""
        return self._by(self.eager.sized(step_size))

    def with_scene(self, scene: Scene) -> Self:
        """The same simulator of the same scene with other numbers: as a new one would be, but no device is asked for anything."""
        return self._by(self.eager.with_scene(scene))

    def _by(self, eager: EagerStepper[S]) -> Self:
        other = copy.copy(self)
        other.eager, other._made, other._carrying = eager, None, None
        return other

    def initial_state(self, q: Array | None = None, v: Array | None = None, control: Array | None = None) -> S:
        """State at configuration q `[*batch, nq]` (None: the rest configuration) and velocity v `[*batch, nv]` (None: at rest).
        One configuration goes to all worlds where the velocity, gravity or the articulation's parameters have several.

        Each may be a tensor of the scene's dtype and device, a numpy array or a list. The start is of second order, or of first
        order in a world whose trial step is unsolved, if the integrator needs one. Raises `InputError` for wrong shapes, dtypes and
        devices, for NaN and infinity, for coordinates beyond 1e9 (m, rad) and velocities beyond 1e6 (m/s, rad/s), and for
        quaternions of no length."""
        q, v = self.scene.placed(q, v)
        control = self.scene.controlled(control, q.shape[:-1])
        if self._carriers().may_carry(q, v, control):
            linked = Linked(self.eager, self.gradients, self._maker)
            if linked.carry(q, v, control):
                return linked.initial_state(q, v, control)
        return self.stepper.initial_state(q, v, control)

    def objective(self, state: S, control: Tensor | None = None) -> BalanceObjective:
        """The balance of forces that the step from `state` solves."""
        return self.eager.objective(state, control)

    def step(self, state: S, control: Array | None = None) -> tuple[S, Solution]:
        """One step of all worlds under `control` `[*batch, nu]` (None: zero), a tensor, a numpy array or a list. Never raises for
        one bad world: see the solution's status. An unsolved world goes on from the best point found. One whose state or control is
        not finite or beyond the bounds (docs/SOLVERS.md) stands still, with the status `NON_FINITE`. Raises `InputError` for wrong
        shapes, dtypes and devices.

        Where the state, the control, the scene's numbers or dt carry derivatives, so does the new state, by the implicit function
        theorem (`gradients.implicit`); the values are the same to the bit."""
        control = self.scene.controlled(control, state.q.shape[:-1])
        if self._carriers().may_carry(*vars(state).values(), *state.memory, control):
            linked = Linked(self.eager, self.gradients, self._maker)
            if linked.carry(state, control):
                return stepped(linked, state, control)
        advanced, solution, _ = self.stepper.made(state, control)
        return advanced, solution

    def trajectory(
        self,
        state: S,
        controls: Tensor | None = None,
        steps: int | None = None,
        checkpoint: int = 1,
        progress: Callable[[int], object] | None = None,
    ) -> Trajectory[S]:
        """Steps from `state` and keeps what carries derivatives: configurations, velocities, and how each step was solved.

        controls, steps: as in `rollout`. checkpoint: keep every so many-th state only, for less memory and about twice the time.
        progress: called with the number of steps done. Raises `InputError` where controls and steps do not agree."""
        return trajectory(self.eager, self.gradients, self._maker, state, controls, steps, checkpoint, progress)

    def linearize(self, state: S, control: Tensor | None = None) -> Linearization[S]:
        """The step from `state` under `control` `[*batch, nu]` as A `[*batch, nx, nx]` and B `[*batch, nx, nu]` in the coordinates
        of `Chart`: exact derivatives, all worlds and all rows in one pass. Raises `GradientError` at unsolved and singular
        steps unless `gradients` says otherwise."""
        return linearized(self.eager, self.gradients, self._maker, state, control)

    def rollout(
        self,
        state: S,
        controls: Tensor | None = None,
        steps: int | None = None,
        progress: Callable[[int], object] | None = None,
    ) -> Rollout:
        """Steps from `state` and records everything.

        controls: `[steps, *batch, nu]`, or None for zero control; then `steps` says how many. progress: called after every step
        with the number of steps done; it may raise KeyboardInterrupt, which ends the rollout early and keeps what was computed.
        Raises `ContactOverflowError`, which holds the steps done, where the scene asks for it."""
        return self.roller(self.stepper, state, controls, steps, progress)


REBOUND = 2e-3  # [s], the shortest step in which contacts give way and push back


class AdaptiveSimulator(Simulator[S]):
    """A `Simulator` whose steps, the frames, are made of as many shorter ones as each world needs (`AdaptiveStepper`).

    `dt`: length of a frame, and of the longest step [s]. `accuracy`: what a step's end may be off by, as estimated [m] > 0:
    the root mean square over the mass of a body, the largest of all bodies. `shortest`: a step that is never refused [s]; None:
    dt/4096, and where contacts have restitution, which is a law of one step, 2 ms: shorter ones would take the rebound away.
    `engine`: as in `Simulator`."""

    def __init__(
        self,
        scene: Scene,
        dt: float,
        accuracy: float,
        integrator: Integrator[S] | None = None,
        solver: Solver | None = None,
        shortest: float | None = None,
        engine: Engine | None = None,
    ) -> None:
        if shortest is None and any(getattr(term, "restitution", None) is not None for term in scene.terms):
            shortest = min(dt, max(dt / 4096, REBOUND))
        self._accuracy = Accuracy.within(dt, accuracy, shortest)
        super().__init__(scene, dt, integrator, solver, halvings=0, engine=engine)

    def _stepping(self) -> tuple[Stepper[S], str, str]:
        if self._made is None:
            fixed, name, reason = super()._stepping()
            self._made = self._framed(fixed), name, reason
        return self._made

    def _framed(self, fixed: Stepper[S]) -> Stepper[S]:
        if isinstance(fixed, NativeStepper) and not fixed.moving:
            return fixed.framed(self._accuracy)
        return AdaptiveStepper(fixed, self._accuracy)  # where obstacles are is asked for at each step's own times

    def step(self, state: S, control: Array | None = None) -> tuple[S, Solution]:
        """See `Simulator.step`. Raises `InputError` where something carries derivatives: which steps are taken depends on it, but
        not smoothly."""
        control = self.scene.controlled(control, state.q.shape[:-1])
        if Linked(self.eager, self.gradients, self._maker).carry(state, control):
            raise InputError(NO_DERIVATIVES)
        return super().step(state, control)

    def trajectory(self, *_: Any, **__: Any) -> Trajectory[S]:
        """Raises `InputError`: steps of no one length are made in no one way."""
        raise InputError(ROLLOUTS_ONLY)

    def linearize(self, *_: Any, **__: Any) -> Linearization[S]:
        """Raises `InputError`, as `trajectory` does."""
        raise InputError(ROLLOUTS_ONLY)


class EventSimulator(Simulator[S]):
    """A `Simulator` whose steps are cut at the instant at which something strikes on the way of an explicit one, and at that at
    which a contact stops sliding (`schedules.events`, `schedules.stops`): up to there, and from there on. So impacts happen, and
    slides end, when they should, and derivatives go through them.

    `integrator`: one that makes explicit steps, `RungeKutta`; None: that one. The rest: as in `Simulator`. Raises `InputError`
    for others. A step is cut at most five times, and no closer to its start than 1e-6 of it: what strikes again so soon, and what
    strikes while something else presses, does so within a step as in a `Simulator`. Sliding stops where 2 slip speeds of the
    friction law (`CoulombFriction`, `StaticFriction`) are left, in contacts that have slid at more than 4 and press all along;
    other laws, and `BodyContact` with obstacles that move, stop within a step as in a `Simulator`. The
    solution's `strike` is the share of the step after which something first strikes, its `steps` the parts of it, whatever it was
    cut for. Each part is a call of its own, a rollout is not one call of the core, and steps in which something slides cost some
    milliseconds more. Derivatives by autograd and forward_ad, not by torch.func."""

    def __init__(
        self,
        scene: Scene,
        dt: float,
        integrator: Integrator[S] | None = None,
        solver: Solver | None = None,
        halvings: int = 3,
        gradients: Gradients | None = None,
        engine: Engine | None = None,
    ) -> None:
        chosen_one: Integrator[Any] = RungeKutta() if integrator is None else integrator
        if not isinstance(chosen_one, Leaping):
            name = type(chosen_one).__name__
            raise InputError(f"integrator is {name}: an EventSimulator needs one that makes explicit steps, such as RungeKutta")
        super().__init__(scene, dt, chosen_one, solver, halvings, gradients, engine=engine)

    def _stepping(self) -> tuple[Stepper[S], str, str]:
        if self._made is None:
            fixed, name, reason = super()._stepping()
            self._made = EventStepper(fixed), name, reason
        return self._made

    def _maker(self, eager: EagerStepper[Any]) -> Stepper[Any]:
        """Of parts: not what cuts them."""
        maker = super()._maker(eager)
        return maker.fixed if isinstance(maker, EventStepper) else maker

    def step(self, state: S, control: Array | None = None) -> tuple[S, Solution]:
        """See `Simulator.step` and `schedules.events.made_with_events`."""
        control = self.scene.controlled(control, state.q.shape[:-1])
        if not self._carriers().may_carry(*vars(state).values(), *state.memory, control):
            return self.stepper.made(state, control)[:2]

        def make(eager: EagerStepper[Any], start: Any, held: Tensor | None) -> tuple[Any, Solution]:
            linked = Linked(eager, self.gradients, self._maker)
            if not linked.carry(start, held):
                return self._maker(eager).made(start, held)[:2]
            end, made = linked.step(start, held)
            return end, made.solution

        return made_with_events(make, self.eager, state, control)

    def trajectory(
        self,
        state: S,
        controls: Tensor | None = None,
        steps: int | None = None,
        checkpoint: int = 1,
        progress: Callable[[int], object] | None = None,
    ) -> Trajectory[S]:
        """See `Simulator.trajectory`; every state is kept: raises `InputError` for another checkpoint than 1."""
        if checkpoint != 1:
            raise InputError(f"checkpoint is {checkpoint}: steps that are cut keep every state, so it must be 1")
        states, status = [state], []
        for k in range(self.scene.step_count(controls, steps)):
            state, solution = self.step(state, None if controls is None else controls[k])
            states.append(state)
            status.append(solution.status)
            if progress is not None:
                progress(k + 1)
        v = [self.integrator.velocity(self.articulation, x, self.step_size) for x in states]
        return Trajectory(torch.stack([x.q for x in states]), torch.stack(v), state, torch.stack(status))

    def linearize(self, *_: Any, **__: Any) -> Linearization[S]:
        """Raises `InputError`: a step that may be cut is differentiated as it is made, by `step`."""
        raise InputError("an EventSimulator does not linearise its steps: differentiate `step`, or use a Simulator")


NO_DERIVATIVES = "the steps of an AdaptiveSimulator carry no derivatives: detach what requires them, or use a Simulator"
ROLLOUTS_ONLY = "an AdaptiveSimulator has rollouts only: use a Simulator for trajectories and linearisations"
