"""What all environments share: a batch of worlds that torchrl steps and resets, without state of its own."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from pbfd_torch import memory
from pbfd_torch.envs.packing import packed, unpacked
from pbfd_torch.envs.randomization import DrawnWorlds, Randomization
from pbfd_torch.envs.seeds import checked_seed, checked_seeds
from pbfd_torch.errors import InputError
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator, State
from pbfd_torch.models.setup import Setup
from pbfd_torch.simulator import AdaptiveSimulator, Simulator
from pbfd_torch.solvers.per_world import chosen
from pbfd_torch.stepping.stepper import SHORTEST_STEP
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.actuators import Actuators

DRAWN = ("world_factors", "world_push")  # what worlds differ by; no integrator's state has fields of these names
KEPT = ("start_v", *DRAWN)  # of an episode, from its start
HALVINGS = 1  # of a step that nothing else solves
POOL = 256  # starts that are made at once, at most 16 for each world, unless more are needed: a solve each


@dataclass(frozen=True, eq=False)
class Step:
    """What happened in a control step of all worlds.

    Attributes:
        before, q, v: configuration before and after `[worlds, nq]`, and velocity after `[worlds, nv]`.
        action: `[worlds, nu]`, within its range.
        time: [s] that passed.
    """

    before: Tensor
    q: Tensor
    v: Tensor
    action: Tensor
    time: float


@dataclass(frozen=True, eq=False)
class Outcome:
    """A control step's end, with derivatives where the state or the action carry them.

    Attributes:
        state: of the integrator.
        observation: `[worlds, nobs]` in the simulation's dtype.
        reward: `[worlds]`.
        terminated: `[worlds]` bool, by the task or because a step is unsolved.
        unsolved: `[worlds]` bool.
    """

    state: State
    observation: Tensor
    reward: Tensor
    terminated: Tensor
    unsolved: Tensor


class PbfdEnv(EnvBase):  # type: ignore[misc]  # torchrl has no types
    """A batch `[num_envs]` of worlds. Subclasses say what the scene is, what is seen, and what is good.

    The tensordict holds "observation" (float32), "action" (float32, from −1 to 1 or the actuators' range), "reward", "done",
    "terminated", "truncated", "unsolved", and "state": the integrator's state, the step count and, with a `randomization`, what
    each world has drawn. Nothing else is remembered, so any tensordict of an earlier step can be gone on from.

    Arguments:
        num_envs: worlds ≥ 1. device, dtype (float64 or float32): of the simulation.
        seed: of resets and randomisation; None: 0.
        control_dt: [s] between actions; None: the task's. dt: [s] step of the simulation, a whole fraction of it; None: the same.
        accuracy: [m] > 0, instead of `dt`: each world chooses its own steps for it, see `AdaptiveSimulator`; without derivatives.
        integrator: None: implicit Euler, the paper's: at control steps of 8 ms of robots that stand on the ground it is about as
            accurate as the others and cheaper.
        max_episode_steps: after which an episode is truncated; None: the task's.
        randomization: see `Randomization`.

    Attributes: `low`, `high` `[nu]`: the range of actions, in the dtype of the simulation; `scene`, `simulator`: what is stepped.

    Actions out of range are clipped, and costs are those of the clipped action. An action with NaN counts as zero, and its world is
    terminated and marked "unsolved", as is one whose step has no solution; its last observation is the one before. Raises
    `InputError` for arguments out of range, and for actions of another shape."""

    batch_locked = True
    task_dt = 0.008
    task_steps = 1000
    planar = True  # moves in the x–z plane

    def __init__(
        self,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
        seed: int | None = None,
        control_dt: float | None = None,
        dt: float | None = None,
        integrator: Integrator[Any] | None = None,
        max_episode_steps: int | None = None,
        randomization: Randomization | None = None,
        accuracy: float | None = None,
    ) -> None:
        memory.require_room("num_envs", num_envs)
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.control_dt = self.task_dt if control_dt is None else control_dt
        self.dt = self.control_dt if dt is None else dt
        for name, step in (("control_dt", self.control_dt), ("dt", self.dt)):
            if not (math.isfinite(step) and step >= SHORTEST_STEP):
                raise InputError(f"{name} is {step} s: must be ≥ {SHORTEST_STEP:g} and finite")
        self.substeps = round(self.control_dt / self.dt)
        if self.substeps < 1 or abs(self.substeps * self.dt - self.control_dt) > 1e-9 * self.control_dt:
            raise InputError(f"dt is {self.dt} s: must divide the control step, {self.control_dt} s")
        self.max_episode_steps = self.task_steps if max_episode_steps is None else max_episode_steps
        if self.max_episode_steps < 1:
            raise InputError(f"max_episode_steps is {self.max_episode_steps}: must be ≥ 1")
        self.randomization = randomization
        self.setup = self.make_setup(dtype, torch.device(device))
        self.scene = self.setup.scene
        self.accuracy = accuracy
        self.simulator = self._simulator(integrator)
        self._worlds = None if randomization is None else DrawnWorlds(self.simulator, randomization)
        (bank,) = (term for term in self.scene.terms if isinstance(term, Actuators))
        self.low, self.high = bank.control_range.unbind(-1)
        if not bool(torch.isfinite(bank.control_range).all()):
            raise InputError("actuators of an environment need control ranges")
        self._seed = 0 if seed is None else checked_seed(seed)
        self._set_seed(self._seed)
        start = self._fresh(1)
        self._like: State = self._state_like
        self._make_specs(start)
        self._set_seed(self._seed)  # the probe has drawn numbers

    def _simulator(self, integrator: Integrator[Any] | None) -> Simulator[Any]:
        if self.accuracy is None:
            # a world that is hard to solve ends sooner than others wait for it
            return Simulator(self.scene, self.dt, integrator or ImplicitEuler(), halvings=HALVINGS)
        if self.substeps > 1:
            raise InputError(f"dt is {self.dt} s and accuracy {self.accuracy} m: only one of them may be given")
        return AdaptiveSimulator(self.scene, self.control_dt, self.accuracy, integrator)

    # what a task says ------------------------------------------------------------------------------------------------

    @abstractmethod
    def make_setup(self, dtype: torch.dtype, device: torch.device) -> Setup:
        """The scene, for one world, with one bank of actuators that have ranges."""

    @abstractmethod
    def observe(self, q: Tensor, v: Tensor) -> Tensor:
        """`[worlds, nobs]`."""

    @abstractmethod
    def reward(self, step: Step) -> Tensor:
        """`[worlds]`."""

    def healthy(self, q: Tensor, v: Tensor) -> Tensor:
        """`[worlds]` bool: whether the episode goes on."""
        return torch.ones_like(q[:, 0], dtype=torch.bool)

    def start(self, worlds: int, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Where episodes start, `[worlds, nq]` and `[worlds, nv]`: the setup's start with noise of `noise` on every entry."""
        q, v = (x.expand(worlds, -1) for x in (self.setup.q, self.setup.v))
        return self._noisy(q, random), self._noisy(v, random)

    noise = 5e-3

    def _noisy(self, value: Tensor, random: torch.Generator) -> Tensor:
        share = torch.rand(value.shape, generator=random, dtype=torch.float64, device=value.device).to(value.dtype)
        return value + self.noise * (2 * share - 1)

    # torchrl's side --------------------------------------------------------------------------------------------------

    def _make_specs(self, start: Mapping[str, Tensor]) -> None:
        shape, device = self.batch_size, self.device
        width = self.observe(self.setup.q[:1], self.setup.v[:1]).shape[-1]
        state = Composite(
            {name: Unbounded((*shape, *value.shape[1:]), dtype=value.dtype, device=device) for name, value in start.items()},
            shape=shape,
        )
        self.observation_spec = Composite(
            observation=Unbounded((*shape, width), dtype=torch.float32, device=device),
            unsolved=Binary(1, (*shape, 1), dtype=torch.bool, device=device),
            state=state,
            shape=shape,
        )
        self.state_spec = Composite(state=state.clone(), shape=shape)
        low, high = (x.float().expand(*shape, -1).clone() for x in (self.low, self.high))
        self.action_spec = Bounded(low, high, shape=low.shape, dtype=torch.float32, device=device)
        flags = {name: Binary(1, (*shape, 1), dtype=torch.bool, device=device) for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(flags, shape=shape)
        self.reward_spec = Unbounded((*shape, 1), dtype=torch.float32, device=device)

    @property
    def _supports_set_state(self) -> bool:
        return True

    def _set_seed(self, seed: int | None) -> None:
        self._random = self._generator(0 if seed is None else seed)
        self._rows: list[torch.Generator] = []  # one for each world, once these have seeds of their own
        self._pool: dict[str, Tensor] = {}

    def _generator(self, seed: int) -> torch.Generator:
        return torch.Generator(self.device).manual_seed(seed)

    def set_seeds(self, seeds: Sequence[int | None]) -> None:
        """Gives every world random numbers of its own: what it draws from now on follows from its seed, whatever other worlds do.

        seeds: one for each world, from 0 to 2⁶⁴ − 1; None goes on with what that world had. `set_seed` ends it. Raises
        `InputError` for another number of them."""
        worlds = math.prod(self.batch_size)
        found = checked_seeds(list(seeds), worlds)
        assert isinstance(found, list)
        if not self._rows:
            drawn = torch.randint(2**62, (worlds,), generator=self._random, device=self.device)
            self._rows = [self._generator(seed) for seed in drawn.tolist()]
        self._rows = [row if seed is None else self._generator(seed) for row, seed in zip(self._rows, found, strict=True)]

    def _reset(self, tensordict: TensorDictBase | None = None, set_state: bool = False, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if set_state and mask is None and tensordict is not None and "state" in tensordict:
            flat = dict(tensordict["state"].items())
            state = unpacked(flat, self._like)
            # at a start an integrator's own velocity may be that of the step before it
            v = torch.where(flat["steps"] == 0, flat["start_v"], self._velocity(self.simulator, state))
            return self._seen(state.q, v, flat)
        where = torch.ones(self.batch_size, dtype=torch.bool, device=self.device) if mask is None else mask.reshape(self.batch_size)
        index = where.nonzero().squeeze(-1)
        fresh = self._begun(index.tolist()) if self._rows else self._taken(len(index))
        # rows that are not reset are not read: torchrl keeps those of the step
        whole = {name: value.new_zeros((*self.batch_size, *value.shape[1:])) for name, value in fresh.items()}
        flat = {name: value.index_copy(0, index, fresh[name]) for name, value in whole.items()}
        return self._seen(flat["q"], flat["start_v"], flat)

    def _seen(self, q: Tensor, v: Tensor, flat: Mapping[str, Tensor]) -> TensorDictBase:
        none = torch.zeros((*self.batch_size, 1), dtype=torch.bool, device=self.device)
        return TensorDict(
            {
                "observation": self.observe(q, v).float(),
                "unsolved": none,
                "done": none.clone(),
                "terminated": none.clone(),
                "truncated": none.clone(),
                "state": TensorDict(dict(flat), self.batch_size),
            },
            self.batch_size,
            device=self.device,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        for name, source in (("state", "reset or set_state gives it"), ("action", "the policy gives it")):
            if name not in tensordict.keys():  # noqa: SIM118  (a tensordict's `in` asks for something else)
                raise InputError(f"a step from a tensordict without '{name}': {source}")
        flat = dict(tensordict["state"].items())
        action = tensordict["action"]
        if not action.is_floating_point():
            raise InputError(f"action is {action.dtype}: must be floating-point numbers")
        if action.shape != self.action_spec.shape:
            raise InputError(f"action has shape {tuple(action.shape)}: must be {tuple(self.action_spec.shape)}")
        with torch.no_grad():
            outcome = self.advanced(unpacked(flat, self._like), action, flat)
        steps = flat["steps"] + 1
        truncated = (steps >= self.max_episode_steps) & ~outcome.terminated[:, None]
        state = packed(outcome.state) | {"steps": steps} | {name: flat[name] for name in KEPT if name in flat}
        if self.randomization is not None:
            state["world_push"] = self._pushed(self.randomization, flat["world_push"])
        return TensorDict(
            {
                "observation": outcome.observation.float(),
                "reward": outcome.reward.float()[:, None],
                "unsolved": outcome.unsolved[:, None],
                "terminated": outcome.terminated[:, None],
                "truncated": truncated,
                "done": outcome.terminated[:, None] | truncated,
                "state": TensorDict(state, self.batch_size),
            },
            self.batch_size,
            device=self.device,
        )

    # the simulation's side -------------------------------------------------------------------------------------------

    def advanced(self, state: State, action: Tensor, drawn: Mapping[str, Tensor] | None = None) -> Outcome:
        """A control step from a state under an action `[worlds, nu]`, with derivatives where these carry any. drawn: what the
        worlds of a `randomization` have drawn, as in the tensordict's "state"."""
        simulator = self._of(drawn)
        bad = torch.isnan(action).any(-1)
        control = torch.where(bad[:, None], 0.0, action).to(self.scene.articulation.dtype).clamp(self.low, self.high)
        now, solved = state, ~bad
        for _ in range(self.substeps):
            now, solution = simulator.step(now, control)
            solved = solved & solution.solved
        v = self._velocity(simulator, now)
        finite = torch.isfinite(now.q).all(-1) & torch.isfinite(v).all(-1)
        unsolved = ~(solved & finite)
        now = chosen(unsolved, state, now)
        v = torch.where(unsolved[:, None], self._velocity(simulator, state), v)
        terminated = unsolved | ~self.healthy(now.q, v)
        reward = self.reward(Step(state.q, now.q, v, control, self.control_dt))
        return Outcome(now, self.observe(now.q, v), torch.where(unsolved, 0.0, reward), terminated, unsolved)

    def starts(self, worlds: int) -> tuple[State, Tensor]:
        """States at the first step of so many episodes, and what is seen of them, `[worlds, nobs]` in the simulation's dtype."""
        flat = self._taken(worlds)
        state = unpacked(flat, self._like)
        return state, self.observe(state.q, flat["start_v"])

    def set_state(self, q: Tensor, v: Tensor) -> TensorDictBase:
        """The tensordict of worlds at q `[num_envs, nq]` with velocity v `[num_envs, nv]`, to step on from: the first of an
        episode. Raises `InputError` for wrong shapes and NaN."""
        for what, value, width in (("q", q, self.scene.articulation.nq), ("v", v, self.scene.articulation.nv)):
            if value.shape != (*self.batch_size, width):
                raise InputError(f"{what} has shape {tuple(value.shape)}: must be {(*self.batch_size, width)}")
        flat = self._started(q, v, self._drawn(len(q), self._random))
        return self._seen(flat["q"], flat["start_v"], flat)

    def _velocity(self, simulator: Simulator[Any], state: State) -> Tensor:
        return simulator.integrator.velocity(simulator.articulation, state, simulator.step_size)

    def _of(self, drawn: Mapping[str, Tensor] | None) -> Simulator[Any]:
        """The simulator of worlds with what they have drawn."""
        if self._worlds is None or drawn is None:
            return self.simulator
        return self._worlds.simulator(*(drawn[name] for name in DRAWN))

    def _started(self, q: Tensor, v: Tensor, drawn: dict[str, Tensor] | None) -> dict[str, Tensor]:
        """Packed states at q with v, at the first step of an episode of worlds with what they have drawn."""
        flat = {"steps": torch.zeros((len(q), 1), dtype=torch.int64, device=q.device), "start_v": v.clone()}
        with torch.no_grad():
            state = self._of(drawn).initial_state(q, v)
            if self.accuracy is not None:  # a state has it after its first step, and is to be of one kind always
                state = replaced(state, pace=torch.full_like(state.time, self.control_dt))
        self._state_like = state
        return packed(state) | flat | (drawn or {})

    def _drawn(self, worlds: int, random: torch.Generator) -> dict[str, Tensor] | None:
        return None if self.randomization is None else self.randomization.drawn(worlds, random)

    def _pushed(self, randomization: Randomization, push: Tensor) -> Tensor:
        if not self._rows:
            return randomization.pushed(push, self._random)
        return torch.cat([randomization.pushed(one, random) for one, random in zip(push.split(1), self._rows, strict=True)])

    def _fresh(self, worlds: int) -> dict[str, Tensor]:
        return self._started(*self.start(worlds, self._random), self._drawn(worlds, self._random))

    def _begun(self, rows: Sequence[int]) -> dict[str, Tensor]:
        """Starts of these worlds, each from its own random numbers."""
        starts = [(self.start(1, self._rows[k]), self._drawn(1, self._rows[k])) for k in rows]
        q, v = (torch.cat(x) for x in zip(*(start for start, _ in starts), strict=True))
        each = [drawn for _, drawn in starts if drawn is not None]
        return self._started(q, v, {name: torch.cat([x[name] for x in each]) for name in DRAWN} if each else None)

    def _taken(self, worlds: int) -> dict[str, Tensor]:
        """As many starts, out of a pool that is filled when it is empty: a solve for many costs little more than one for a few."""
        have = len(next(iter(self._pool.values()))) if self._pool else 0
        if have < worlds:
            made = self._fresh(max(worlds, min(POOL, 16 * math.prod(self.batch_size))))
            self._pool = {name: torch.cat((self._pool[name], x)) for name, x in made.items()} if self._pool else made
        first = {name: value[:worlds] for name, value in self._pool.items()}
        self._pool = {name: value[worlds:] for name, value in self._pool.items()}
        return first
