"""Physical parameters come back from noisy motion, with the deviations that they are said to have; what motion does not show is
said to be unknown."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pbfd_torch import InputError, Scene, Simulator
from pbfd_torch.identify import (
    Case,
    CenterOfMass,
    Configurations,
    Experiment,
    Identification,
    Markers,
    Mass,
    Parameter,
    Prior,
    Spread,
    Start,
    Stopping,
)
from pbfd_torch.identify.report import report
from pbfd_torch.tree.kinematics import place, retract
from pbfd_torch.tree.rotations import quaternion_exp
from tests.identified_scenes import DAMPING, GAIN, MU, STIFFNESS, pushed_box, servo_arm

QUICK = Stopping(iterations=25, step=1e-4, decrease=1e-4)  # a hundredth of what the noise leaves open
FRICTION = Parameter("μ", (MU,), lower=0.0, upper=1.0)


def randoms(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def motion(scene: Scene, q: Tensor, v: Tensor, dt: float, controls: Tensor) -> Tensor:
    """q `[steps, runs, nq]` after every step."""
    simulator = Simulator(scene, dt)
    made = simulator.trajectory(simulator.initial_state(q, v), controls)
    assert bool(made.solved.all())
    return made.q[1:]


def noisy(scene: Scene, q: Tensor, share: float, sets: tuple[int, ...], seed: int) -> Configurations:
    """Measurements `[steps, *sets, runs, nq]` with noise of this share of how far the scene moves, and of half a turn of balls."""
    t = scene.articulation.topology
    deviation = torch.full((t.nv,), share * math.pi, dtype=q.dtype)
    moved = q[..., t.scalar_q]
    deviation[t.scalar_v] = share * (moved.amax((0, 1)) - moved.amin((0, 1))).amax()
    noise = deviation * randoms(len(q), *sets, q.shape[1], len(deviation), seed=seed)
    return Configurations(retract(scene.articulation, q.reshape(len(q), *(1,) * len(sets), *q.shape[1:]), noise), deviation)


ARM = (
    Parameter("shoulder damping", (DAMPING,), (0,), lower=0.0, upper=1.0, unit="N m s"),
    Parameter("elbow damping", (DAMPING,), (1,), lower=0.0, upper=1.0, unit="N m s"),
    Parameter("servo gain", (GAIN, STIFFNESS), lower=0.0, upper=30.0, unit="N m/rad"),
)


def arm_experiment(sets: tuple[int, ...], noise: float) -> tuple[Experiment, Tensor]:
    """The real arm swings for .6 s while its servo is told to go to and fro; and what is believed of it."""
    real = servo_arm((0.15, 0.05), 8.0)
    q, v = torch.tensor([[0.8, 0.0], [-0.5, 0.9]]).double(), torch.tensor([[0.0, 1.0], [0.5, 0.0]]).double()
    time = torch.arange(30, dtype=torch.float64) * 0.02
    controls = 0.6 * torch.stack((torch.sin(10 * time), torch.cos(15 * time)), -1)[..., None]
    measured = noisy(real, motion(real, q, v, 0.02, controls), noise, sets, seed=1)
    believed = Case(servo_arm((0.4, 0.4), 3.0), q, v)
    return Experiment(believed, measured, 0.02, controls), torch.tensor([0.15, 0.05, 8.0]).double()


def test_arm() -> None:
    """Damping and servo gain from 6 data sets at once: to 2 % of the gain, and spread as they are said to be."""
    experiment, truth = arm_experiment(sets=(6,), noise=0.01)
    identification = Identification(experiment, ARM)
    found = identification.fit(identification.start.expand(6, 3), horizons=(10,), stopping=QUICK)
    assert bool(found.fit.converged.all())
    assert float((found.values[:, 2] / truth[2] - 1).abs().max()) < 0.02
    off = torch.stack([(one.values - truth) / one.certainty.deviation for one in (found[k] for k in range(6))])
    assert float(off.abs().max()) < 4
    assert 0.6 < float(off.square().mean().sqrt()) < 1.5
    assert float(found.variance.mean()) == pytest.approx(1, abs=0.2)
    assert bool(found.best.certainty.determined.all())
    text = report(found)
    assert "servo gain" in text
    assert "!" not in text


def test_what_scales_together() -> None:
    """An arm with twice the masses, damping and gain moves the same: data do not tell that factor, and the report says so."""
    experiment, truth = arm_experiment(sets=(), noise=0.01)
    found = Identification(experiment, [Mass("upper"), Mass("fore"), *ARM]).fit(horizons=(10,), stopping=QUICK)
    known = found.certainty
    assert len(known.loose) == 1
    assert not bool(known.determined[:2].any())
    ratios = found.values[2:] / found.values[1]
    assert float(ratios[2]) == pytest.approx(float(truth[2]), rel=0.05)
    assert "! the data do not determine the combination" in report(found)


def test_bounds_are_reported() -> None:
    experiment, _ = arm_experiment(sets=(), noise=0.01)
    gain = Parameter("servo gain", (GAIN, STIFFNESS), lower=0.0, upper=6.0)
    found = Identification(experiment, [*ARM[:2], gain]).fit(horizons=(10,), stopping=QUICK)
    assert float(found.values[2]) == 6
    text = report(found)
    assert "! servo gain is at its bound" in text
    assert "held" in text.splitlines()[3]
    assert "larger than the stated noise" in text


def test_where_an_arm_started() -> None:
    """The same when nobody looked how the runs began, seen by markers of which one is hidden for a while."""
    experiment, truth = arm_experiment(sets=(), noise=1e-12)
    exact = experiment.measured
    assert isinstance(exact, Configurations)
    links, places = torch.tensor([0, 1]), torch.tensor([[0.0, 0, -0.4], [0.05, 0, -0.4]]).double()
    a = experiment.case.scene.articulation
    poses = place(a, exact.q).poses[..., links, :3, :]
    points = (poses[..., :3] @ places[..., None]).squeeze(-1) + poses[..., 3]
    points = points + 1e-3 * randoms(*points.shape, seed=4)
    points[10:20, :, 1] = torch.nan
    q = experiment.case.q + 0.1 * randoms(2, 2, seed=2)
    case = Case(experiment.case.scene, q, torch.zeros_like(q))
    start = Start(torch.full((2,), 0.2).double(), torch.full((2,), 1.0).double())
    marked = Experiment(case, Markers(links, places, points, 1e-3), experiment.dt, experiment.controls)
    found = Identification(marked, [*ARM, start]).fit(horizons=(10,), stopping=QUICK)
    assert bool(found.fit.converged)
    known = found.certainty
    assert bool(known.determined.all())
    off = (found.values[:3] - truth) / known.deviation[:3]
    assert float(off.abs().max()) < 4
    moved = found.identification.case(found.fit.x)
    torch.testing.assert_close(moved.q, experiment.case.q, rtol=0, atol=5e-3)
    torch.testing.assert_close(moved.v, experiment.case.v, rtol=0, atol=0.1)


def test_jacobian_against_differences() -> None:
    """Of all kinds of unknowns, through the whole of a toss."""
    experiment = toss(pushed_box(2.0, (0.02, -0.015, 0.01), 0.4), runs=2, steps=16, sets=())
    start = Start(torch.ones(6).double(), torch.ones(6).double())
    identification = Identification(experiment, [Mass("box"), CenterOfMass("box"), Spread("box"), FRICTION, start])
    x = identification.start
    _, jacobian = identification.linearized(x)
    direction = randoms(len(x), seed=1) * 1e-4
    change = 0.5 * (identification.residual(x + direction) - identification.residual(x - direction))
    torch.testing.assert_close(jacobian @ direction, change, rtol=1e-3, atol=1e-3 * float(change.abs().max()))


def toss(scene: Scene, runs: int, steps: int, sets: tuple[int, ...], believed: Scene | None = None) -> Experiment:
    """A force of 30 N holds a box up, throws it for .18 s, it tumbles, lands and slides; measured with 1 % noise."""
    a = scene.articulation
    q = a.rest.repeat(runs, 1)
    q[:, 2] = 0.3
    turns = [[0.0, 0, 0], [0.3, 0, 0], [0, 0.3, 0.1]]
    q[:, 3:] = quaternion_exp(torch.tensor(turns).double())[:runs]
    v = q.new_zeros(runs, a.nv)
    controls = q.new_zeros(steps, runs, 3)
    controls[:6, :, 0], controls[:6, :, 2] = 12, 30
    controls[:6, 1, 1] = 5
    measured = noisy(scene, motion(scene, q, v, 0.03, controls), 0.01, sets, seed=1)
    return Experiment(Case(scene if believed is None else believed, q, v), measured, 0.03, controls)


def test_tossed_box() -> None:
    """Mass, centre of mass and μ of a box to 2 %, each of three random starts with its own noise."""
    truth = torch.tensor([2.0, 0.02, -0.015, 0.01, 0.4]).double()
    real, believed = pushed_box(2.0, (0.02, -0.015, 0.01), 0.4), pushed_box(2.0, (0.0, 0.0, 0.0), 0.4)
    identification = Identification(toss(real, 3, 26, (3,), believed), [Mass("box"), CenterOfMass("box"), FRICTION])
    starts = identification.start + randoms(3, 5, seed=7).clamp(-2, 2) * torch.tensor([0.1, 0.01, 0.01, 0.01, 0.15]).double()
    found = identification.fit(starts, horizons=(12, 19), stopping=Stopping(25, step=1e-3, decrease=1e-3))
    assert bool(found.fit.converged.all())
    off = found.values - truth
    assert float((off[:, 0] / truth[0]).abs().max()) < 0.02
    assert float(torch.linalg.vector_norm(off[:, 1:4], dim=-1).max() / torch.linalg.vector_norm(truth[1:4])) < 0.02
    assert float((off[:, 4] / truth[4]).abs().max()) < 0.02
    known = found.best.certainty
    assert bool(known.determined.all())
    assert float((off.abs() / known.deviation).max()) < 4


def slide() -> Experiment:
    """A box slides freely to rest: Coulomb friction slows it by μ g whatever its mass."""
    scene = pushed_box(2.0, (0.0, 0.0, 0.0), 0.4)
    q = scene.articulation.rest[None].clone()
    q[:, 2] = 0.0985
    v = q.new_zeros(1, 6)
    v[:, 0] = 1.5
    controls = q.new_zeros(20, 1, 3)
    measured = noisy(scene, motion(scene, q, v, 0.03, controls), 0.01, (), seed=3)
    return Experiment(Case(pushed_box(2.5, (0.0, 0.0, 0.0), 0.3), q, v), measured, 0.03, controls)


def test_a_sliding_box_does_not_tell_its_mass() -> None:
    found = Identification(slide(), [Mass("box"), FRICTION]).fit(stopping=QUICK)
    known = found.certainty
    assert known.determined.tolist() == [False, True]
    assert float(found.values[1]) == pytest.approx(0.4, rel=0.02)
    text = report(found)
    assert "! the data do not determine box: mass" in text
    assert "not determined" in text.splitlines()[1]


def test_a_prior_is_a_measurement() -> None:
    mass = Mass("box")
    identification = Identification(slide().first(4), [mass, FRICTION], [Prior(mass, 0.01)])
    found = identification.fit(stopping=QUICK)
    known = found.certainty
    assert bool(known.determined[0])
    assert float(found.values[0]) == pytest.approx(2.5, rel=0.05)
    assert float(known.deviation[0]) == pytest.approx(2 * 0.01 * 2.5, rel=0.5)


def test_progress_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    experiment, _ = arm_experiment(sets=(), noise=0.01)
    Identification(experiment.first(5), ARM[2:]).fit(progress=True, stopping=Stopping(2), starts=torch.tensor([[3.0]]).double())
    assert "5 steps" in capsys.readouterr().err


def test_input_errors() -> None:
    experiment, _ = arm_experiment(sets=(), noise=0.01)
    case = experiment.case
    with pytest.raises(InputError, match="at least one"):
        Identification(experiment, [])
    with pytest.raises(InputError, match=r"no parameter named terms\.9\.mu"):
        Identification(experiment, [Parameter("μ", ("terms.9.mu",))]).fit()
    with pytest.raises(InputError, match="must be ≥ 0 and < 2"):
        Identification(experiment, [Parameter("damping", (DAMPING,), (2,))]).fit()
    with pytest.raises(InputError, match="a number that is 0 needs one"):
        Identification(experiment, [Parameter("bias", ("terms.2.bias",))]).fit()
    with pytest.raises(InputError, match="no link named 'hand'"):
        Identification(experiment, [Mass("hand")]).fit()
    with pytest.raises(InputError, match="none of the unknowns"):
        Identification(experiment, ARM, [Prior(Mass("fore"), 1.0)])
    with pytest.raises(InputError, match="steps is 99"):
        experiment.first(99)
    with pytest.raises(InputError, match="must be \\[30, 2, 1\\]"):
        Experiment(case, experiment.measured, 0.02, torch.zeros(3, 2, 1).double())
    with pytest.raises(InputError, match="must be \\[runs, 2\\]"):
        Case(case.scene, case.q[0], case.v[0])
    with pytest.raises(InputError, match="factor is 1"):
        Mass("fore", 1.0)
    with pytest.raises(InputError, match="distance is 0"):
        CenterOfMass("fore", 0.0)
