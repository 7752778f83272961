"""Contact between bodies by the compiled core is the reference's: loads, J across branches, steps, hazards, memory."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Scene, Simulator
from pbfd_torch.contact.hazards import Hazard, Overflow
from pbfd_torch.integrators.energy_momentum import Velocities
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.native.engine import Native
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import NativeStepper, uncovered
from pbfd_torch.solvers.objective import Status
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.body_contact import BodyContact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.tree.kinematics import retract
from tests.native_parity import compared, require_balance, resting
from tests.native_piles import SHAPES, pile, thrown_together

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

WORLDS, DT = 10, 0.01
LAWS: dict[str, FrictionLaw] = {"coulomb": CoulombFriction(1.0), "anchored": AnchoredFriction(1.0, stretch=1e-3)}


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", SHAPES)
def test_loads_and_their_jacobian(name: str, law: str) -> None:
    """r and J where bodies overlap, turn and slip, those of bodies on different branches too."""
    scene = pile(SHAPES[name], LAWS[law])
    q, v = thrown_together(scene, 2 * WORLDS)
    state = resting(q, v)
    simulator = Simulator(scene, DT)
    touched = 0
    guess = simulator.objective(state, None).guess
    nudge = 0.02 * torch.rand(2 * WORLDS, scene.articulation.nv, generator=torch.Generator().manual_seed(1), dtype=q.dtype)
    for there in (guess, retract(scene.articulation, guess, nudge)):
        require_balance(scene, state, there)
        touched += int((simulator.objective(state, None).evaluate(there).jacobian[:, :6, 6:].abs().amax((-2, -1)) > 0).sum())
    assert touched > WORLDS / 2


def remembered(state: Any) -> list[Tensor]:
    """What the anchors of pairs of bodies know, in an order that does not go by slots: `[worlds, slots, 7]`, nothing of those that
    have let go."""
    found = []
    for x in state.memory:
        if x.shape[-1] == 7:
            kept = torch.where(x[..., 6:] >= 0, x, torch.zeros_like(x))
            key = kept @ x.new_tensor([0.541, 0.273, 0.119, 0.913, 0.377, 0.229, 0.067])
            found.append(kept.take_along_dim(key.argsort(-1)[..., None], -2))
    return found


CASES = [(name, "coulomb", scheme) for name in SHAPES for scheme in ("energy-momentum", "implicit-euler")]
CASES += [("polytopes", "anchored", scheme) for scheme in INTEGRATORS]


@pytest.mark.parametrize(("name", "law", "integrator"), CASES)
def test_steps(name: str, law: str, integrator: str) -> None:
    """Steps end where the reference's do, with the same hazards and memory; what the core calls solved is so by the reference."""
    simulator = Simulator(pile(SHAPES[name], LAWS[law]), DT, INTEGRATORS[integrator]())
    native = simulator.stepper
    assert isinstance(native, NativeStepper), simulator.engine_reason
    state = simulator.initial_state(*thrown_together(simulator.scene, WORLDS))
    pairs = compared(native, state, None, 1 if law == "coulomb" else 2)
    objective = pairs.stepper.objective(pairs.before, None)
    plain = pairs.solution.status == int(Status.SOLVED)
    assert int((objective.error(objective.evaluate(pairs.after.q), 1e-9)[plain] > 1e-9).sum()) <= 1
    direct, alike = int(pairs.both.sum()), pairs.alike
    pairs.require_alike(["hazards"], 0, 0)
    for ours, theirs in zip(remembered(pairs.after), remembered(pairs.expected), strict=True):
        assert torch.allclose(ours[alike], theirs[alike], 1e-5, 1e-8)
    assert direct - int(alike.sum()) <= max(1, 0.03 * direct)  # bodies that overlap deep have several roots
    assert direct > 0
    assert int((pairs.solution.status > int(Status.HALVED)).sum()) <= 1


@pytest.mark.parametrize("name", ["balls on boxes", "polytopes"])
def test_a_world_in_any_batch(name: str) -> None:
    """To the bit: alone, in another order, beside a sick one, on several threads, many steps in one call."""
    scene = pile(SHAPES[name], LAWS["anchored"])
    simulator = Simulator(scene, DT, engine=Native(threads=1))
    native = simulator.stepper
    assert isinstance(native, NativeStepper)
    q, v = thrown_together(scene, WORLDS)
    state = simulator.initial_state(q, v)
    states, solution = native.run(state, None, 6)
    for index in ([3], [WORLDS - 1, 0, 3]):
        some = Worlds((WORLDS,), torch.tensor(index))
        part, _ = native.take(some).run(state.take(some), None, 6)
        for ours, theirs in zip((part.q, part.v, *part.memory), (states.q, states.v, *states.memory), strict=True):
            assert torch.equal(ours, theirs[:, index])
    sick = replace(state, q=state.q.index_put((torch.tensor([5]),), torch.tensor(torch.nan, dtype=q.dtype)))
    beside, _ = native.run(sick, None, 6)
    well = [w for w in range(WORLDS) if w != 5]
    assert torch.equal(beside.q[:, well], states.q[:, well])
    shared, _ = NativeStepper(native.eager, threads=3).run(state, None, 6)
    assert torch.equal(shared.q, states.q)
    for k in range(6):
        state, one, _ = native.made(state, None)
        assert torch.equal(one.status, solution.status[k])
        assert torch.allclose(state.q, states.q[k], 0.0, 1e-8)


def marked(scene: Scene, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """The hazards of one step by the core, and by the reference."""
    simulator = Simulator(scene, DT)
    native = simulator.stepper
    assert isinstance(native, NativeStepper)
    state: Velocities = simulator.initial_state(q, v)
    return native.made(state, None)[0].hazards, native.eager.made(state, None)[0].hazards


def test_hazards() -> None:
    """Candidates dropped, bodies that went further than was looked, overlaps."""
    scene = pile(SHAPES["boxes"])
    q, v = thrown_together(scene, 6)
    few = tuple(replace(x, finder=replace(x.finder, slots=6)) if isinstance(x, BodyContact) else x for x in scene.terms)
    ours, theirs = marked(replace(scene, terms=few), q, v)
    assert torch.equal(ours & Hazard.CANDIDATES_DROPPED, theirs & Hazard.CANDIDATES_DROPPED)
    assert bool((ours & Hazard.CANDIDATES_DROPPED).any())
    ours, theirs = marked(scene, q, v)
    assert torch.equal(ours & Hazard.OVERLAPPED, theirs & Hazard.OVERLAPPED)
    assert bool((ours & Hazard.OVERLAPPED).any())
    blind = tuple(replace(x, slack=1e-6) if isinstance(x, BodyContact) else x for x in scene.terms)
    ours, theirs = marked(replace(scene, terms=blind), q, torch.zeros_like(v))  # what lies in another one is pushed out fast
    assert bool((theirs & Hazard.MOVED_TOO_FAR).any())
    assert int(((ours ^ theirs) & Hazard.MOVED_TOO_FAR > 0).sum()) <= 1  # another root


@pytest.mark.parametrize("name", SHAPES)
def test_float32(name: str) -> None:
    """Steps in single precision are solved, and stay near those in double."""
    ends = []
    for dtype in (torch.float32, torch.float64):
        scene = pile(SHAPES[name], dtype=dtype)
        simulator = Simulator(scene, DT)
        assert simulator.engine == "native"
        q, v = thrown_together(pile(SHAPES[name]), WORLDS, spread=0.6)
        after, solution = simulator.step(simulator.initial_state(q.to(dtype), v.to(dtype)))
        assert bool(solution.solved.all())
        ends.append(after.q.double())
    off = (ends[0] - ends[1]).abs().amax(-1)
    assert float(off.median()) < 1e-4


def test_other_overflow_is_said() -> None:
    """Slots that grow, or raise, are PyTorch's."""
    scene = pile(SHAPES["boxes"])
    grown = tuple(replace(x, overflow=Overflow.GROW) if isinstance(x, BodyContact) else x for x in scene.terms)
    simulator = Simulator(replace(scene, terms=grown), DT)
    assert "overflow GROW" in uncovered(simulator.eager)
    assert simulator.engine == "torch"
