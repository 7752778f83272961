"""Live mode: a scene is stepped in real time, and pushed, steered and changed while it moves."""

from __future__ import annotations

import dataclasses
import math
import threading
import time
from collections.abc import Sequence
from typing import Any

import torch
import viser
from torch import Tensor

from pbfd_torch.balance.dynamics import mass_matrix
from pbfd_torch.errors import InputError
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models.setup import Setup
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.pushes import Pushes
from pbfd_torch.viewer import server as serving
from pbfd_torch.viewer.film import Film
from pbfd_torch.viewer.served import Served
from pbfd_torch.viewer.stage import Stage
from pbfd_torch.viewer.strides import strode

STEPS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1)  # [s] to choose from
FRAME = 0.02  # [s] from picture to picture where steps are shorter, and the longest that steps are made without one
_WIDEST = math.pi  # [rad or m] of a joint's slider without limits
_SERVO = 20.0  # [rad/s] how fast a joint follows its slider, critically damped


class Live(Served):
    """Steps world 0 of a setup in real time at an `address`, until `close`.

    dt: step [s], None: the scene's; integrator: one of `INTEGRATORS`. Sliders: control of the scene's actuators, or joint targets
    where it has none, a push on a chosen link, μ; Δt and integrator to choose; buttons: pause, reset. host, port, origins: as of
    `Inspector`. Raises `InputError` for what is out of range."""

    def __init__(
        self,
        setup: Setup,
        dt: float | None = None,
        integrator: str = "energy-momentum",
        host: str = serving.HOST,
        port: int = serving.PORT,
        origins: Sequence[str] = (),
    ) -> None:
        if integrator not in INTEGRATORS:
            raise InputError(f"integrator is '{integrator}': must be one of {', '.join(INTEGRATORS)}")
        super().__init__()
        first = Worlds((setup.worlds,), torch.zeros(1, dtype=torch.long))
        setup = dataclasses.replace(setup, scene=setup.scene.take(first), q=setup.q[:1], v=setup.v[:1])
        scene = setup.scene
        self._start = setup.q, setup.v
        self._targets = not scene.nu
        self._scene = _with_servos(scene) if self._targets else scene
        self._dt, self._integrator = setup.dt if dt is None else dt, integrator
        self._push = setup.q.new_zeros(scene.articulation.nlink, 3)
        self._mu: float | None = None
        self._control = _first_control(setup, self._scene)
        self._lock = threading.RLock()
        self._paused = False
        self.steps, self.time = 0, 0.0
        self._rebuild(*self._start)
        self.film = Film(self._advanced(1)[0])
        self._rebuild(*self._start)
        self.server = serving.start(host, port, origins=origins)
        try:
            self.stage = Stage(self.server, self.film)
            self.stage.contacts.points = self.stage.contacts.forces = True
            self.stage.follows = scene.articulation.topology.link_parent.count(-1) == 1  # of several bodies one may fall off
            self._build(self.server.gui)
            self.stage.look()
        except BaseException:
            self.close()
            raise
        self._clock = threading.Thread(target=self._run, name="live", daemon=True)
        self._clock.start()

    @property
    def q(self) -> Tensor:
        """The configuration now `[nq]`."""
        return self._state.q[0]

    def _ended(self) -> None:
        if hasattr(self, "_clock"):
            self._clock.join(60.0)  # a step that is being solved must not outlive the interpreter

    # stepping -------------------------------------------------------------------------------------------------------------

    def _rebuild(self, q: Tensor, v: Tensor) -> None:
        """A simulator of what the sliders say now, going on from (q, v)."""
        scene = self._scene if self._mu is None else with_friction(self._scene, self._mu)
        pushes = Pushes.at_centers(scene.articulation, self._push)
        scene = dataclasses.replace(scene, terms=(*scene.terms, pushes))
        self._simulator: Simulator[Any] = Simulator(scene, self._dt, INTEGRATORS[self._integrator]())
        self._state: Any = self._simulator.initial_state(q, v, self._control)

    def _velocity(self) -> Tensor:
        simulator = self._simulator
        return simulator.integrator.velocity(simulator.articulation, self._state, simulator.step_size)

    def _advanced(self, most: int) -> tuple[Rollout, list[Solution]]:
        """Up to so many steps, as long as they take no longer than a picture: the record of the last, and how they were solved, a
        few `[steps, 1]` at a time."""
        usual, control = max(1, round(FRAME / self._dt)), self._control
        solutions: list[Solution] = []
        began, count = time.perf_counter(), 0
        while count < most and (count == 0 or time.perf_counter() - began < FRAME):
            stride = strode(self._simulator, self._state, control, min(usual, most - count))
            self._state, count = stride.after, count + stride.steps
            solutions.append(stride.solution)
        return stride.record(), solutions

    def _run(self) -> None:
        due = time.perf_counter()
        while not self._closed.is_set():
            late = max(0.0, time.perf_counter() - due)
            if late > 0.25:  # slower than real time: it does not try to catch up
                due, late = time.perf_counter(), 0.0
            with self._lock:  # a reset is not followed by a step that was begun before it
                due += FRAME if self._paused else self._dt * self.step(max(1, round((FRAME + late) / self._dt)))
            self._closed.wait(max(0.0, due - time.perf_counter()))

    def step(self, most: int = 1) -> int:
        """A step, or up to so many, as long as they take no longer than a picture; draws the last. How many there were."""
        with self._lock:
            started = time.perf_counter()
            record, solutions = self._advanced(most)
            self.film.renew(record)
            status, solved, evaluations = (
                torch.cat([getattr(x, name)[:, 0] for x in solutions]) for name in ("status", "solved", "evaluations")
            )
            count = len(status)
            self.steps += count
            self.time += count * self._dt
            spent = time.perf_counter() - started
            if self._closed.is_set():
                return count
            self.stage.show(record.steps)
            shown = -1 if bool(solved.all()) else int(solved.long().argmin())  # the first that was not solved, or the last
            word = Status(int(status[shown])).name.lower().replace("_", " ")
            red = "" if bool(solved[shown]) else "**"
            self._words.content = (
                f"{self.time:.2f} s · {red}{word}{red}, {int(evaluations[shown])} evaluations · "
                f"{count * self._dt / max(spent, 1e-9):.1f} × real time at most"
            )
        return count

    def reset(self) -> None:
        """Back to the start, drawn."""
        with self._lock:
            self._rebuild(*self._start)
            self.step()
            self.stage.show(0)  # where that step began
            self._rebuild(*self._start)
            self.steps, self.time = 0, 0.0

    # controls -------------------------------------------------------------------------------------------------------------

    def _change(self, **changes: Any) -> None:
        """Goes on from here with other settings."""
        with self._lock:
            q, v = self._state.q, self._velocity()
            for name, value in changes.items():
                setattr(self, f"_{name}", value)
            self._rebuild(q, v)

    def _build(self, gui: viser.GuiApi) -> None:
        gui.add_markdown(f"### {self._scene.name}, live")
        self._words = gui.add_markdown("")
        pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        reset = gui.add_button("Reset", icon=viser.Icon.REFRESH)
        steps = sorted({*STEPS, self._dt})
        dt = gui.add_dropdown("Δt [s]", tuple(f"{x:g}" for x in steps), initial_value=f"{self._dt:g}")
        scheme = gui.add_dropdown("Integrator", tuple(INTEGRATORS), initial_value=self._integrator)
        mu = gui.add_slider("Friction μ", 0.0, 1.5, 0.05, _common_mu(self._scene), hint="Of all contacts, once it is moved.")
        follow = gui.add_checkbox("Follow", self.stage.follows, hint="Keep the centre of mass in its place.")
        with gui.add_folder("Push"):
            self._add_push(gui)
        with gui.add_folder("Joint targets" if self._targets else "Control"):
            self._add_controls(gui)

        @pause.on_click
        def _(_: object) -> None:
            self._paused = not self._paused
            pause.label = "Go on" if self._paused else "Pause"

        reset.on_click(lambda _: self.reset())

        dt.on_update(lambda _: self._change(dt=float(dt.value)))
        scheme.on_update(lambda _: self._change(integrator=scheme.value))
        mu.on_update(lambda _: self._change(mu=float(mu.value)))
        follow.on_update(lambda _: setattr(self.stage, "follows", follow.value))

    def _add_push(self, gui: viser.GuiApi) -> None:
        a = self._scene.articulation
        most = round(3 * float(a.mass.reshape(-1, a.nlink)[0].sum()) * 9.81, 1)
        link = gui.add_dropdown("Link", a.link_names)
        sliders: list[Any] = [gui.add_slider(f"{axis} [N]", -most, most, most / 100, 0.0) for axis in "xyz"]
        none = gui.add_button("Let go")

        def push(_: object) -> None:
            force = torch.zeros_like(self._push)
            force[a.link_index(link.value)] = self._push.new_tensor([float(x.value) for x in sliders])
            self._change(push=force)

        @none.on_click
        def _(_: object) -> None:
            for slider in sliders:
                slider.value = 0.0

        link.on_update(push)
        for slider in sliders:
            slider.on_update(push)

    def _add_controls(self, gui: viser.GuiApi) -> None:
        banks = [term for term in self._scene.terms if isinstance(term, Actuators)]
        names = [name for bank in banks for name in bank.names]
        ranges = torch.cat([bank.control_range for bank in banks]) if banks else torch.zeros(0, 2)
        for k, (name, (low, high)) in enumerate(zip(names, ranges.tolist(), strict=True)):
            low, high = max(low, -_WIDEST), min(high, _WIDEST)
            first = min(max(float(self._control[0, k]), low), high)
            slider = gui.add_slider(name, low, high, (high - low) / 200, first)

            def steer(event: viser.GuiEvent[viser.GuiSliderHandle[float]], k: int = k) -> None:
                with self._lock:
                    self._control = self._control.clone()
                    self._control[0, k] = float(event.target.value)

            slider.on_update(steer)


def with_friction(scene: Scene, mu: float) -> Scene:
    """The scene with one μ for all contacts."""
    found = parameters(scene)
    last = {name: name.rsplit(".", 1)[-1] for name in found}
    changed = {name: torch.full_like(value, mu) for name, value in found.items() if name.endswith(".friction.mu")}
    changed |= {name: torch.ones_like(value) for name, value in found.items() if last[name] == "grip"}
    return with_parameters(scene, changed)


def _common_mu(scene: Scene) -> float:
    found = parameters(scene)
    mus = [float(value.mean()) for name, value in found.items() if name.endswith(".friction.mu")]
    grips = [float(value.mean()) for name, value in found.items() if name.rsplit(".", 1)[-1] == "grip"]
    return min(1.5, (grips or mus or [0.0])[0])


def _with_servos(scene: Scene) -> Scene:
    """The scene with a position servo on every hinge and slide that is not at the root of a free body's tree."""
    a = scene.articulation
    names = [name for name, size in zip(a.joint_names, a.topology.joint_sizes, strict=True) if size == (1, 1)]
    if not names:
        return scene
    inertia = mass_matrix(a, a.rest, scene.terms).detach().reshape(-1, a.nv, a.nv)[0]
    felt = 1 / torch.linalg.inv(inertia).diagonal()
    servos = []
    for name in names:
        j = a.joint_index(name)
        dof = a.topology.v_start[j]
        low, high = float(a.lower.reshape(-1, a.nv)[0, dof]), float(a.upper.reshape(-1, a.nv)[0, dof])
        kp = _SERVO**2 * float(felt[dof])
        servo = Actuator.position(name, name, kp, 2 * kp / _SERVO)
        servos.append(dataclasses.replace(servo, control_range=(max(low, -_WIDEST), min(high, _WIDEST))))
    terms: list[Term] = [*scene.terms, Actuators.from_list(a, servos)]
    return dataclasses.replace(scene, terms=tuple(terms))


def _first_control(setup: Setup, scene: Scene) -> Tensor:
    """The scene's own control, or the joints' coordinates at the start as targets."""
    if setup.scene.nu or scene is setup.scene:
        return setup.controls(1)[0, :1].clone()
    bank = next(term for term in scene.terms if isinstance(term, Actuators))
    return setup.q[:1, bank.coordinate].clone()
