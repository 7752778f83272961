"""Second-order starts by the compiled core are the reference's: the same trial step, and the same state made of it."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from pbfd_torch import Simulator, models
from pbfd_torch.balance.dynamics import mass_matrix
from pbfd_torch.bench.starts import scattered
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.models import SCENES, Setup, file_setup
from pbfd_torch.native.engine import Native
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.solvers.objective import Status
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.contact import Contact
from pbfd_torch.tree.kinematics import place, retract
from tests.native_parity import DT, SCHEMES, apart, at_once, begun, fields, largest_gap, require_starts, trial_of

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

PLANES = ("hopper", "walker", "chain-fixed")
SPACE = ("hopper3d", "walker3d", "quadruped", "chain-ground", "chain-slope-drop", "box-slope", "dzhanibekov")
WORLDS = 48


def of(name: str, dtype: torch.dtype = torch.float64, worlds: int = WORLDS) -> Setup:
    if name in SCENES:
        return SCENES[name](worlds=worlds, dtype=dtype)
    return file_setup(Path(models.__file__).parent / f"{name}.xml", worlds, dtype)


@functools.cache
def starts(name: str) -> tuple[Tensor, Tensor, Tensor]:
    """Worlds that rest on something, strike it, and fly; and controls."""
    setup = of(name)
    a, random = setup.scene.articulation, torch.Generator().manual_seed(1)
    q, v = scattered(setup, 0, 0.3, 1.0)
    v = v * torch.tensor([0.0, 4.0, 1.0], dtype=v.dtype).repeat(WORLDS // 3)[:, None]
    contacts = [term for term in setup.scene.terms if isinstance(term, Contact)]
    if contacts and name != "chain-fixed":
        depth = torch.stack([contact.depth(place(a, q)).amax(-1) for contact in contacts]).amax(0)
        wanted = torch.tensor([1e-3, 0.0, -0.2], dtype=v.dtype).repeat(WORLDS // 3)
        wanted = wanted * torch.rand(WORLDS, dtype=v.dtype, generator=random)
        up = (place(a, q).axes[0, :, 5] > 0.999) & (place(a, q).axes[0, :, :3].abs().sum(-1) < 1e-6)
        q = retract(a, q, (depth - wanted)[:, None] * up.to(q.dtype))
    return q, v, 2 * torch.rand(WORLDS, setup.scene.nu, dtype=torch.float64, generator=random) - 1


def traced(eager: EagerStepper[Any], q: Tensor, v: Tensor, control: Tensor) -> tuple[Any, Tensor, Tensor]:
    """The reference's start, where its trial has ended, and with which status."""
    trials = []

    def attempt(stepper: EagerStepper[Any], state: Any, held: Tensor | None) -> tuple[Any, Tensor]:
        end, solution, _ = stepper.made(state, held)
        trials.append((end.q, solution.status))
        return end, solution.solved

    return eager.with_attempt(attempt).initial_state(q, v, control), *trials[0]


@pytest.mark.parametrize("name", PLANES + SPACE)
def test_what_is_made_of_a_trial(name: str) -> None:
    """At rest, in impact, in flight; with a control and without."""
    q, v, control = starts(name)
    scene = of(name).scene
    require_starts(scene, q, v, control)
    require_starts(scene, q, v)


def test_they_touch_strike_and_fly() -> None:
    """These starts do, and impacts are told from what presses."""
    for name in ("hopper", "quadruped", "chain-slope-drop"):
        q, v, control = starts(name)
        native = NativeStepper(Simulator(of(name).scene, DT).eager)
        start = begun(native, q, v, control)
        touching = trial_of(native.eager, q, v, control).push(start.end) > 0
        given = (start.state.push != 0).any(-1)
        assert 0.2 < float(touching.double().mean()) < 0.9, name
        assert bool((touching & given).any()), name
        assert bool((touching & ~given).any()), name


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("name", PLANES + SPACE)
def test_parity(name: str, integrator: Integrator[Any]) -> None:
    """With the reference's own trial: as near as two roots to the same tolerance allow, wherever they are the same root."""
    q, v, control = starts(name)
    native = NativeStepper(Simulator(of(name).scene, DT, integrator).eager)
    start = begun(native, q, v, control)
    reference, end, status = traced(at_once(native.eager), q, v, control)
    solved = int(Status.SOLVED)
    both = (start.status == solved) & (status == solved)
    same = both & ((end - start.end).abs().amax(-1) < 1e-7)
    assert int(same.sum()) >= 0.97 * int(both.sum()) > 0.5 * WORLDS
    assert bool((start.status <= int(Status.HALVED)).all())
    gap = largest_gap(native.eager, q, start.state, reference)
    assert bool((gap <= apart(native.eager, q, v, control) + 1e-10)[same].all())


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("name", ["hopper", "walker3d", "chain-slope-drop"])
def test_float32(name: str, integrator: Integrator[Any]) -> None:
    """What is made of a trial is what float64 makes of it, but for what the Jacobian makes of rounded coordinates."""
    q, v, control = (x.float() for x in starts(name))
    native = NativeStepper(Simulator(of(name, torch.float32).scene, DT, integrator).eager)
    start = begun(native, q, v, control)
    wide = Simulator(of(name).scene, DT, integrator).eager
    at, moving, held, end = q.double(), v.double(), control.double(), start.end.double()
    solved = start.status <= int(Status.HALVED)
    exact = wide.with_attempt(lambda _, state, __: (replaced(state, q=end), solved)).initial_state(at, moving, held)
    objective = trial_of(wide, at, moving, held)
    felt = (objective.evaluate(end).jacobian.abs() * objective.extent[:, None]).sum(-1)
    inverse = torch.linalg.inv(mass_matrix(wide.articulation, at, wide.scene.terms)).abs()
    most = 8 * torch.finfo(torch.float32).eps * (inverse @ felt[..., None])[..., 0]
    names = ("push", "steady", "lag") if isinstance(integrator, EnergyMomentum) else ("acceleration",)
    for name in names:
        ours, theirs = getattr(start.state, name).double(), getattr(exact, name)
        assert bool(((ours - theirs).abs() <= (1.0 if name == "acceleration" else DT) * most).all()), name


@pytest.mark.parametrize("name", ["hopper", "walker3d", "chain-slope-drop"])
def test_float32_trials(name: str) -> None:
    """To float64 their ends are as near to a root as the reference's: rounded coordinates leave more than the tolerance in both."""
    q, v, control = (x.float() for x in starts(name))
    native = NativeStepper(Simulator(of(name, torch.float32).scene, DT).eager)
    start = begun(native, q, v, control)
    _, end, status = traced(at_once(native.eager), q, v, control)
    objective = trial_of(Simulator(of(name).scene, DT).eager, q.double(), v.double(), control.double())
    ours, theirs = (objective.error(objective.evaluate(x.double()), 1e-3) for x in (start.end, end))
    both = (start.status == int(Status.SOLVED)) & (status == int(Status.SOLVED))
    assert float(both.double().mean()) > 0.5
    assert float(ours[both].mean()) <= 1.25 * float(theirs[both].mean())
    assert float(ours[both].square().mean()) <= 1.5**2 * float(theirs[both].square().mean())


@pytest.mark.parametrize("integrator", SCHEMES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", ["walker", "walker3d"])
def test_no_lane_knows_another(name: str, dtype: torch.dtype, integrator: Integrator[Any]) -> None:
    """To the bit: in another place of a batch, by itself, in a batch of another shape, beside worlds that are not finite, on
    threads."""
    q, v, control = (x.to(dtype) for x in starts(name))
    native = NativeStepper(Simulator(of(name, dtype).scene, DT, integrator).eager, threads=1)
    whole = native.initial_state(q, v, control)
    order = torch.randperm(WORLDS, generator=torch.Generator().manual_seed(3))
    for index in (order, order[:5], order[7:8], order[8]):
        some = native.initial_state(q[index], v[index], control[index])
        for field, ours, theirs in fields(some, mapped(lambda x, rows=index: x[rows], whole)):
            assert torch.equal(ours, theirs), field
    shaped = native.initial_state(*(x.unflatten(0, (3, -1)) for x in (q, v, control)))
    for field, ours, theirs in fields(shaped, mapped(lambda x: x.unflatten(0, (3, -1)), whole)):
        assert torch.equal(ours, theirs), field
    sick, fast, others = q.clone(), v.clone(), torch.arange(WORLDS) > 1
    sick[0], fast[1] = torch.nan, 1e6
    for field, ours, theirs in fields(native.initial_state(sick, fast, control), whole):
        assert torch.equal(ours[others], theirs[others]), field
    many = [x.repeat(12, 1) for x in (q, v, control)]
    threaded = NativeStepper(native.eager, threads=3)
    for field, ours, theirs in fields(threaded.initial_state(*many), native.initial_state(*many)):
        assert torch.equal(ours, theirs), field


@pytest.mark.parametrize("integrator", SCHEMES)
def test_worlds_that_cannot_be_stepped(integrator: Integrator[Any]) -> None:
    """Coordinates, velocities and controls that are not finite or beyond the bounds: the reference's state, NaN where that is."""
    q, v, control = (x[:9].clone() for x in starts("walker"))
    q[0, 1], v[1, 2], v[2, 3], control[3, 0], control[4, 1] = torch.nan, torch.nan, torch.inf, torch.nan, torch.inf
    v[5, 4], q[6, 0], v[7, 0] = 2e4, 2e9, 2e6
    native = NativeStepper(Simulator(of("walker").scene, DT, integrator).eager)
    start = begun(native, q, v, control)
    assert start.status.tolist()[:8] == [int(Status.NON_FINITE)] * 8
    for field, ours, theirs in fields(start.state, native.eager.initial_state(q, v, control)):
        assert torch.allclose(ours, theirs, 1e-7, 1e-5, equal_nan=True), field  # 2e9 m are rounded to 0.2 µm


def test_unsolved_trials() -> None:
    """Of first order there, as the reference's; what it gives up is unsolved."""
    q, v, control = starts("walker")
    for integrator in SCHEMES:
        eager = Simulator(of("walker").scene, 0.1, integrator, halvings=0, evaluations=200).eager
        native = NativeStepper(eager.changed(evaluations=3))
        start = begun(native, q, 3 * v, control)
        assert bool((start.status > int(Status.HALVED)).any())
        for field, ours, theirs in fields(start.state, start.reference):
            assert torch.allclose(ours, theirs, 1e-8, 1e-8), field


@pytest.mark.parametrize("integrator", SCHEMES)
def test_starts_that_carry_derivatives(integrator: Integrator[Any]) -> None:
    """Their values are those of the others, to the bit."""
    setup = of("hopper", worlds=3)
    q, v = setup.q.clone(), setup.v + 0.1
    simulator = Simulator(setup.scene, DT, integrator, engine=Native())
    plain, expected = simulator.initial_state(q, v), simulator.stepper.initial_state(q, v, None)
    for field, ours, theirs in fields(plain, expected):
        assert torch.equal(ours, theirs), field
    carrying = simulator.initial_state(q.clone().requires_grad_(), v)
    moved = carrying.v if isinstance(integrator, EnergyMomentum) else carrying.q_previous
    assert moved.requires_grad
    for field, ours, theirs in fields(carrying, expected):
        assert torch.equal(ours.detach(), theirs), field
    with forward_ad.dual_level():
        dual = simulator.initial_state(q, forward_ad.make_dual(v, torch.ones_like(v)))
        assert forward_ad.unpack_dual(dual.q_previous if not isinstance(integrator, EnergyMomentum) else dual.v).tangent is not None
