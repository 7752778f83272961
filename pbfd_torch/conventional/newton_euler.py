"""Newton–Euler in generalised coordinates with complementarity contact: the conventional formulation, as DART and Drake step it.

One step from (q, v), Δt, everything linearised at its start (Eq. 1, 2, 7):
    A (v⁺ − v) = −Δt (h + r) + Jᵀλ,   A = M + Δt² K,   q⁺ = q ⊕ Δt v⁺,
M(q) the mass matrix with armatures, h(q, v) Coriolis, centrifugal and gravity forces, and (J, λ) of `constraints` and
`complementarity`: contacts, joint limits and dry friction of joints. Springs, dampings and actuators are linearly implicit, as
DART's are: r is their load where the joints coast to, q ⊕ Δt v, and K how it changes. The bias force h is explicit; that is what
limits Δt where links turn fast.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from pbfd_torch.balance.dynamics import bias_force, mass_matrix
from pbfd_torch.conventional.complementarity import FrictionProblem, Impulses, solve
from pbfd_torch.conventional.constraints import Constraints, contact_constraints, dry_friction_constraints, limit_constraints
from pbfd_torch.conventional.recording import Recorder, Touched
from pbfd_torch.errors import InputError
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.solvers.objective import FALLBACKS, Solution
from pbfd_torch.tensors.worlds import Worlds, replaced
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import DryFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_limits import JointLimits
from pbfd_torch.terms.joint_springs import Armature
from pbfd_torch.terms.load import JointLoad, StepContext, Term
from pbfd_torch.tree.kinematics import place, retract

ROUNDING = 32.0  # rounding errors of a velocity that a solution may hold, in units of its last place


@dataclass(frozen=True, eq=False)
class VelocityState:
    """What Newton–Euler needs to go on.

    Attributes:
        q, v: `[*batch, nq]` and `[*batch, nv]`.
        time: `[*batch]` [s].
        impulse: `[*batch, n, 3]` [N s] of all constraints in the last step: the guess for the next one.
    """

    q: Tensor
    v: Tensor
    time: Tensor
    impulse: Tensor

    def take(self, worlds: Worlds) -> Self:
        """The state of some worlds."""
        return replaced(
            self,
            q=worlds.pick(self.q, 1),
            v=worlds.pick(self.v, 1),
            time=worlds.pick(self.time, 0),
            impulse=worlds.pick(self.impulse, 2),
        )


class NewtonEuler:
    """Steps a scene as conventional engines do; its interface is `Simulator`'s.

    Of contacts only the geometry and μ count: they are rigid, inelastic, and obey Coulomb's law as it stands; joint limits are
    rigid too, and dry friction of joints has no slip speed.

    `dt`: step [s] > 0. `stabilisation`: the share β in [0, 1] of a penetration that one step undoes; what it pushes out with stays
    in the velocity, so it is mild; with 0 the drift of the linearised gaps would add up. `tolerance`: of the complementarity
    conditions, `Impulses.residual_norm`; its scale is the impulse of gravity in one step, or the contacts' own. `limit`: Newton
    steps a step.

    Raises `InputError` for terms that this formulation does not have: contact between links or with convex obstacles by
    `BodyContact`, torsional friction, restitution, friction laws other than Coulomb's."""

    def __init__(self, scene: Scene, dt: float, stabilisation: float = 0.2, tolerance: float = 1e-8, limit: int = 200) -> None:
        if not (math.isfinite(dt) and dt > 0):
            raise InputError(f"dt is {dt} s: must be > 0 and finite")
        if not 0 <= stabilisation <= 1:
            raise InputError(f"stabilisation is {stabilisation}: must be within [0, 1]")
        if not (math.isfinite(tolerance) and tolerance > 0):
            raise InputError(f"tolerance is {tolerance}: must be > 0 and finite")
        if limit < 1:
            raise InputError(f"limit is {limit}: must be ≥ 1")
        a = scene.articulation
        self.scene = scene
        self.dt = float(dt)
        self.stabilisation, self.tolerance, self.limit = float(stabilisation), float(tolerance), limit
        self.step_size = torch.tensor(dt, dtype=a.dtype, device=a.device)
        self._contacts = [term for term in scene.terms if isinstance(term, Contact)]
        self._dry = [term for term in scene.terms if isinstance(term, JointDryFriction)]
        own = Inertia | Armature | Contact | JointDryFriction | JointLimits
        self._smooth = [term for term in scene.terms if not isinstance(term, own)]
        bounded = (torch.isfinite(a.lower) | torch.isfinite(a.upper)).reshape(-1, a.nv).any(0)
        limited = any(isinstance(term, JointLimits) for term in scene.terms)
        self._limited = bounded.nonzero().squeeze(-1) if limited else None
        self._count = sum(len(x.radius) for x in self._contacts) + len(self._dry) * a.nv
        self._count += 0 if self._limited is None else 2 * len(self._limited)
        strength = torch.linalg.vector_norm(scene.gravity, dim=-1).clamp_min(1.0)
        self._scale = a.mass.sum(-1).sqrt() * strength * self.step_size
        self._check_terms()

    def _check_terms(self) -> None:
        for contact in self._contacts:
            if contact.friction is not None and not isinstance(contact.friction, DryFriction):
                name = type(contact.friction).__name__
                raise InputError(f"a contact has the friction law {name}: must be CoulombFriction, AnchoredFriction or None")
            if contact.restitution is not None:
                raise InputError("a contact has a restitution: must be None, impacts are inelastic here")
        step = self._context(self.initial_state(), None)
        for term in self._smooth:
            _load(term, step)

    def initial_state(self, q: Tensor | None = None, v: Tensor | None = None, control: Tensor | None = None) -> VelocityState:
        """State at configuration q `[*batch, nq]` (None: the rest configuration) and velocity v `[*batch, nv]` (None: at rest), as
        in `Simulator.initial_state`. The control does not matter here. Raises `InputError` for wrong shapes, dtypes, devices or
        NaN."""
        q, v = self.scene.placed(q, v)
        return VelocityState(q, v, torch.zeros_like(q[..., 0]), q.new_zeros((*q.shape[:-1], self._count, 3)))

    def _context(self, state: VelocityState, control: Tensor | None) -> StepContext:
        """The step as terms see it: inertia would end it where everything coasts to."""
        a, h = self.scene.articulation, self.step_size
        coasting = place(a, retract(a, state.q, h * state.v))
        return StepContext(
            dt=h,
            previous=place(a, state.q),
            weight=1 / (h * h),
            target_poses=coasting.poses,
            target_q=coasting.q,
            control=control,
            time=state.time,
            gravity=self.scene.gravity,
        )

    def step(self, state: VelocityState, control: Tensor | None = None) -> tuple[VelocityState, Solution]:
        """One step of all worlds under `control` `[*batch, nu]` (None: zero). Never raises for one bad world: see the solution's
        status. An unsolved world goes on with the best impulses found."""
        advanced, solution, _ = self._step(state, control)
        return advanced, solution

    def _step(self, state: VelocityState, control: Tensor | None) -> tuple[VelocityState, Solution, list[Touched]]:
        a, h = self.scene.articulation, self.step_size
        with torch.no_grad():
            step = self._context(state, control)
            inertia = mass_matrix(a, state.q, self.scene.terms)
            force = bias_force(a, state.q, state.v, self.scene.gravity)
            for term in self._smooth:
                load = _load(term, step)
                inertia, force = inertia + h * h * load.stiffness, force + load.residual
            free = state.v - torch.linalg.solve_ex(inertia, h * force[..., None])[0].squeeze(-1)
            v, impulses, touched = self._constrained(step, inertia, free, state.impulse)
            end = VelocityState(retract(a, state.q, h * v), v, state.time + h, impulses.impulse)
            return end, _solution(end.q, impulses), touched

    def _constrained(
        self, step: StepContext, inertia: Tensor, free: Tensor, guess: Tensor
    ) -> tuple[Tensor, Impulses, list[Touched]]:
        """The velocity at the end of the step, what brings it there from the `free` one, and the contacts' part of that."""
        prepared = [contact.prepare(step) for contact in self._contacts]
        pairs = [self._contact(contact, x, step) for contact, x in zip(self._contacts, prepared, strict=True)]
        parts = [constraints for constraints, _ in pairs]
        if self._limited is not None:
            parts.append(
                limit_constraints(self.scene.articulation, self._limited, step.previous.q, self.step_size, self.stabilisation)
            )
        parts += [dry_friction_constraints(term, self.step_size) for term in self._dry]
        if not parts:
            return free, Impulses.none(free), []
        constraints = Constraints.together(parts, tuple(free.shape[:-1]))
        impulses = solve(self._problem(constraints, inertia, free), guess, self.tolerance, self.limit)
        kick = (constraints.rows * impulses.impulse[..., None]).sum((-3, -2))
        touched, first = [], 0
        for contact, x, (_, frame) in zip(self._contacts, prepared, pairs, strict=True):
            own = impulses.impulse[..., first : first + len(contact.radius), :]
            touched.append(Touched(contact, x, (own[..., None] * frame).sum(-2) / self.step_size))
            first += len(contact.radius)
        return free + torch.linalg.solve_ex(inertia, kick[..., None])[0].squeeze(-1), impulses, touched

    def _contact(self, contact: Contact, prepared: Any, step: StepContext) -> tuple[Constraints, Tensor]:
        return contact_constraints(contact, prepared, step.previous, step.time, step.dt, self.stabilisation)

    def _problem(self, constraints: Constraints, inertia: Tensor, free: Tensor) -> FrictionProblem:
        """What is to be solved, in terms of y = Lᵀ(v − v̂), A = LLᵀ."""
        factor = torch.linalg.cholesky_ex(inertia)[0]
        rows = torch.linalg.solve_triangular(factor, constraints.rows.flatten(-3, -2).mT, upper=False).mT
        velocity = (constraints.rows * free[..., None, None, :]).sum(-1) + constraints.bias
        speed = torch.linalg.vector_norm((factor * free[..., None]).sum(-2), dim=-1)
        return FrictionProblem(
            rows.unflatten(-2, constraints.bias.shape[-2:]),
            velocity,
            constraints.mu,
            constraints.hold,
            self._scale + ROUNDING * torch.finfo(free.dtype).eps / self.tolerance * speed,
        )

    def rollout(
        self,
        state: VelocityState,
        controls: Tensor | None = None,
        steps: int | None = None,
        progress: Callable[[int], object] | None = None,
    ) -> Rollout:
        """Steps from `state` and records everything, as `Simulator.rollout` does; kinetic energy and momenta are those of the
        velocity at the time itself, and the potential energy is gravity's and the springs' alone.

        controls: `[steps, *batch, nu]`, or None for zero control; then `steps` says how many. progress: called after every step
        with the number of steps done; it may raise KeyboardInterrupt, which ends the rollout early and keeps what was computed."""
        count = self.scene.step_count(controls, steps)
        recorder = Recorder(self.scene, self.dt, state.q, state.v, state.time)
        try:
            for k in range(count):
                state, solution, touched = self._step(state, None if controls is None else controls[k])
                recorder.record(state.q, state.v, state.time, solution, touched)
                if progress is not None:
                    progress(k + 1)
        except KeyboardInterrupt:
            if recorder.steps == 0:
                raise
        return recorder.finish()


def _load(term: Term, step: StepContext) -> JointLoad:
    """What a term does where the joints coast to, and how that changes; raises `InputError` where it acts on links."""
    coasting = place(step.previous.articulation, step.target_q)
    load = term.load(term.prepare(step), coasting)
    if not isinstance(load, JointLoad):
        raise InputError(
            f"terms hold a {type(term).__name__}: must be Inertia, Armature, Contact (candidate points at half-spaces and "
            "obstacles), JointLimits, JointDryFriction, or a load on joints"
        )
    return load


def _solution(q: Tensor, impulses: Impulses) -> Solution:
    """As `Simulator.step` reports it; an evaluation is a Newton step or the look at the guess."""
    evaluations = impulses.iterations + 1
    return Solution(
        q=q,
        status=impulses.status,
        residual_norm=impulses.residual_norm,
        iterations=impulses.iterations,
        evaluations=evaluations,
        fallbacks=evaluations.new_zeros((*evaluations.shape, len(FALLBACKS))),
        lanes=int(evaluations.amax()) * evaluations.numel(),
    )
