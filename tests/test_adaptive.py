"""Steps that every world chooses for itself: the error estimate, its control, and what a frame reports."""

from __future__ import annotations

import math

import pytest
import torch

from pbfd_torch import EnergyMomentum, ImplicitEuler, InputError, RungeKutta, Simulator, Status
from pbfd_torch.balance.dynamics import apart
from pbfd_torch.bench.precision_scenes import CASES
from pbfd_torch.contact.shapes import Sphere
from pbfd_torch.integrators.integrator import State
from pbfd_torch.models import SCENES
from pbfd_torch.models.setup import Setup
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.simulator import AdaptiveSimulator
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.tree.kinematics import retract
from tests.bodies import at, diagonal, free_body, on_ground

FRAME = 0.05


def rolled(setup: Setup, accuracy: float, frames: int, frame: float = FRAME) -> Rollout:
    simulator: AdaptiveSimulator[State] = AdaptiveSimulator(setup.scene, frame, accuracy)
    control = setup.controls(frames)
    return simulator.rollout(simulator.initial_state(setup.q, setup.v, control[0]), control)


def test_distance_between_configurations() -> None:
    """A body that is only moved is as far away as it was moved; a thin rod that is turned by φ about its middle has its mass at
    2 sin(φ/2) |x|, whose root mean square over its length L is 2 sin(φ/2) L/√12."""
    setup = SCENES["chain-free"]()
    a, q = setup.scene.articulation, setup.q
    moved = q.clone()
    moved[..., :3] += torch.tensor([0.03, 0.0, 0.04], dtype=torch.float64)
    assert float(apart(a, q, moved)) == pytest.approx(0.05, rel=1e-12)
    last = torch.zeros(1, a.nv, dtype=torch.float64)
    last[0, -1] = 0.2
    link = a.pseudo_inertia[-1]
    about_hinge = math.sqrt(float(link[0, 0] + link[2, 2]) / float(link[3, 3]))  # it turns about +y through its frame
    assert float(apart(a, q, retract(a, q, last))) == pytest.approx(2 * math.sin(0.1) * about_hinge, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "accuracies"),
    [
        ("chain-fixed", (1e-5, 1e-4, 1e-3)),
        ("chain-free", (1e-5, 1e-4, 1e-3)),
        ("box-slide", (1e-6, 1e-5, 1e-4)),
        ("hopper", (1e-5, 1e-4, 1e-3)),
    ],
)
def test_tighter_is_better_and_dearer(name: str, accuracies: tuple[float, float, float]) -> None:
    """Ten times tighter: more steps, and nearer to a run that is ten times tighter still."""
    setup = SCENES[name]()
    best, tight, loose = (rolled(setup, accuracy, 5, 0.1) for accuracy in accuracies)
    errors = [float(apart(setup.scene.articulation, x.q, best.q).square().mean().sqrt()) for x in (tight, loose)]
    steps = [int(x.substeps.sum()) for x in (best, tight, loose)]
    assert errors[0] < errors[1]
    assert steps[0] > steps[1] > steps[2]
    for rollout in (best, tight, loose):
        assert bool(rollout.solved.all())


def test_worlds_go_at_their_own_pace_and_alone() -> None:
    """Chains hung up at different angles: each makes its own number of steps, and the same ones, bitwise, as by itself."""
    setup = SCENES["chain-fixed"](worlds=3)
    q = setup.q.clone()
    q[:, 0] = torch.tensor([0.0, 1.0, math.pi / 2], dtype=torch.float64)  # the last one hangs at rest
    simulator: AdaptiveSimulator[State] = AdaptiveSimulator(setup.scene, FRAME, 1e-4)
    together = simulator.rollout(simulator.initial_state(q, setup.v), steps=8)
    made = together.substeps.sum(0)
    assert int(made[2]) == 2 * 8
    assert int(made[0]) > int(made[2])
    for k in range(3):
        alone = simulator.rollout(simulator.initial_state(q[k : k + 1], setup.v[:1]), steps=8)
        assert torch.equal(alone.q[:, 0], together.q[:, k])
        assert torch.equal(alone.substeps[:, 0], together.substeps[:, k])


def test_pace_is_kept_from_frame_to_frame() -> None:
    """A world goes on with the step that it ended with: whether a second is one rollout or two makes no difference."""
    setup = SCENES["chain-fixed"]()
    simulator: AdaptiveSimulator[State] = AdaptiveSimulator(setup.scene, FRAME, 1e-4)
    state = simulator.initial_state(setup.q, setup.v)
    whole = simulator.rollout(state, steps=6)
    for _ in range(3):
        state, _ = simulator.step(state)
    assert state.pace is not None
    assert float(state.pace) < FRAME
    rest = simulator.rollout(state, steps=3)
    assert torch.equal(rest.q[-1], whole.q[-1])
    assert float(state.time) == pytest.approx(3 * FRAME, rel=1e-12)


def test_shortest_step_is_never_refused() -> None:
    """An accuracy that no step can reach ends in frames of shortest steps, not in an endless search."""
    setup = SCENES["chain-fixed"]()
    simulator: AdaptiveSimulator[State] = AdaptiveSimulator(setup.scene, FRAME, 1e-15, shortest=FRAME / 4)
    _, solution = simulator.step(simulator.initial_state(setup.q, setup.v))
    assert solution.steps is not None
    assert solution.steps.tolist() == [8]
    assert bool(solution.solved.all())


def test_broken_world_leaves_the_others_alone() -> None:
    """NaN in one world: its status says so at once, and the others move on, bitwise as without it."""
    setup = SCENES["chain-fixed"](worlds=3)
    simulator: AdaptiveSimulator[State] = AdaptiveSimulator(setup.scene, FRAME, 1e-3)
    clean = simulator.initial_state(setup.q, setup.v)
    poisoned = clean.q.clone()
    poisoned[1, 0] = math.nan
    dirty = type(clean)(**{**vars(clean), "q": poisoned})
    expected, _ = simulator.step(clean)
    found, solution = simulator.step(dirty)
    assert solution.status.tolist() == [Status.SOLVED, Status.NON_FINITE, Status.SOLVED]
    assert torch.equal(found.q[[0, 2]], expected.q[[0, 2]])


def test_contacts_are_those_of_the_last_step() -> None:
    """A box at rest: the recorded forces carry its weight, whatever steps the frame was made of."""
    rollout = rolled(SCENES["box-slide"](), 1e-4, 20)
    weight = rollout.contact_force[-1].sum(-2)[..., 2]
    assert weight.tolist() == pytest.approx([9.81] * len(weight), rel=1e-6)


def test_any_integrator() -> None:
    """Implicit Euler, first order, needs more steps for the same accuracy."""
    setup = SCENES["chain-fixed"]()
    first = AdaptiveSimulator(setup.scene, FRAME, 1e-3, ImplicitEuler())
    assert isinstance(first, Simulator)
    slow = first.rollout(first.initial_state(setup.q, setup.v), steps=4)
    assert int(slow.substeps.sum()) > int(rolled(setup, 1e-3, 4).substeps.sum())


@pytest.mark.parametrize(
    ("accuracy", "shortest", "message"),
    [
        (0.0, None, "accuracy is 0.0"),
        (math.nan, None, "accuracy is nan"),
        (1e-3, 1.0, "shortest is 1.0"),
        (1e-3, 0.0, "shortest is"),
    ],
)
def test_bad_input(accuracy: float, shortest: float | None, message: str) -> None:
    with pytest.raises(InputError, match=message):
        AdaptiveSimulator(SCENES["chain-fixed"]().scene, FRAME, accuracy, shortest=shortest)


@pytest.mark.parametrize("accuracy", [1e-3, 1e-5, 1e-7])
@pytest.mark.parametrize("scheme", [EnergyMomentum(), RungeKutta()], ids=lambda x: type(x).__name__)
def test_a_rebound_survives_a_tight_accuracy(scheme: EnergyMomentum, accuracy: float) -> None:
    """An elastic ball from .5 m is, after .7 s, where it would be but for what its contact gives way: restitution is a law of one
    step, so an impact may not be made of many."""
    scene = on_ground(free_body(1.0, diagonal(1e-3, 1e-3, 1e-3)), Sphere(0.05), NormalForce(1e8), CoulombFriction(0.5))
    terms = [replaced(term, restitution=Restitution(1.0)) if isinstance(term, Contact) else term for term in scene.terms]
    simulator = AdaptiveSimulator(replaced(scene, terms=tuple(terms)), 0.1, accuracy, scheme)
    rollout = simulator.rollout(simulator.initial_state(at(0.55), torch.zeros(6, dtype=torch.float64)), steps=7)
    gravity = 9.81
    fall = math.sqrt(1 / gravity)
    expected = gravity * fall * (0.7 - fall) - 0.5 * gravity * (0.7 - fall) ** 2
    assert float(rollout.q[-1, 2]) - 0.05 == pytest.approx(expected, rel=0.07)
    assert float(rollout.energy[-1]) == pytest.approx(float(rollout.energy[0]), rel=0.02)


@pytest.mark.parametrize(("name", "most"), [("hopper", (2e-2, 2e-3, 4e-4, 2e-4)), ("walker", (0.1, 2e-2, 4e-3, 2e-3))])
def test_robots_converge_through_impacts(name: str, most: tuple[float, ...]) -> None:
    """Feet and limits strike: a tenth of the accuracy brings the root of a robot closer to where steps of 1e-8 m lead, for half a
    second; after that an early difference is multiplied by what follows."""
    case = CASES[name]
    ends = []
    for accuracy in (1e-3, 1e-4, 1e-5, 1e-6, 1e-8):
        setup = case.setup(1)
        simulator = AdaptiveSimulator(setup.scene, 0.1, accuracy, shortest=2e-5)
        controls = case.controls(0.1, 0.1 * torch.arange(5, dtype=torch.float64)[:, None])
        rollout = simulator.rollout(simulator.initial_state(setup.q, setup.v), controls)
        assert bool(rollout.solved.all())
        ends.append(rollout.link_poses[1:, 0, 0, :, 3])
    errors = [float((x - ends[-1]).norm(dim=-1).square().mean().sqrt()) for x in ends[:-1]]
    assert all(error < limit for error, limit in zip(errors, most, strict=True)), errors
    assert errors[-1] < 0.1 * errors[0]
