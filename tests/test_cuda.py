"""The same results on a CUDA device; skipped where there is none."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Rollout, Simulator
from pbfd_torch.balance.objective import BalanceObjective
from pbfd_torch.models import SCENES
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.named import jtj_lm, lbfgs
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.solvers.progress import Progress

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


def landing(device: str, worlds: int = 4) -> Rollout:
    """The first 20 steps of the chain that drops onto the slope."""
    setup = SCENES["chain-slope-drop"](worlds=worlds, device=device)
    simulator = Simulator(setup.scene, 0.02)
    return simulator.rollout(simulator.initial_state(setup.q, setup.v), steps=20)


def test_cuda_agrees_with_cpu() -> None:
    """Both devices solve every step and agree to the solver's tolerance."""
    cpu, cuda = landing("cpu"), landing("cuda")
    assert bool(cuda.solved.all())
    torch.testing.assert_close(cuda.q.cpu(), cpu.q, rtol=0, atol=1e-6)


def test_cuda_is_deterministic() -> None:
    """Twice the same run is bitwise the same."""
    assert torch.equal(landing("cuda").q, landing("cuda").q)


# Rounds without the host ----------------------------------------------------------------------------------------------

all_solvers = pytest.mark.parametrize("solver", [Descent(), jtj_lm(), lbfgs()], ids=["Newton", "JTJ-LM", "L-BFGS"])


def under_way(solver: Descent) -> tuple[BalanceObjective, Progress]:
    """Four chains that land, three rounds into a step."""
    setup = SCENES["chain-ground"](worlds=4, device="cuda")
    simulator = Simulator(setup.scene, 0.02)
    state = simulator.initial_state(setup.q, setup.v)
    for _ in range(15):
        state, _ = simulator.step(state)
    objective = simulator.objective(state)
    progress = solver.begin(objective, objective.guess, state.q)
    for _ in range(3):
        progress = solver.advance(objective, progress)
    assert bool(progress.running.any())
    return objective, progress


def tensors(progress: Progress) -> list[Tensor]:
    """All tensors in it."""
    found: list[Tensor] = []

    def note(x: Tensor) -> Tensor:
        found.append(x)
        return x

    mapped(note, progress)
    return found


@all_solvers
def test_a_round_waits_for_nothing(solver: Descent) -> None:
    """One round with synchronisation forbidden."""
    with torch.no_grad():
        objective, progress = under_way(solver)
        torch.cuda.synchronize()
        torch.cuda.set_sync_debug_mode("error")
        try:
            after = solver.advance(objective, progress)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    assert bool((after.evaluations >= progress.evaluations).all())


@all_solvers
def test_a_round_as_a_graph(solver: Descent) -> None:
    """One round, recorded and replayed, is bitwise the round run eagerly."""
    with torch.no_grad():
        objective, progress = under_way(solver)
        eager = solver.advance(objective, progress)
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):  # libraries must have made their handles and workspaces before recording
            solver.advance(objective, progress)
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        recorded: Any = None
        with torch.cuda.graph(graph):
            recorded = solver.advance(objective, progress)
        graph.replay()
        torch.cuda.synchronize()
    for found, expected in zip(tensors(recorded), tensors(eager), strict=True):
        assert torch.equal(found.nan_to_num(), expected.nan_to_num())


# Derivatives ----------------------------------------------------------------------------------------------------------


def test_cuda_derivatives_agree_with_cpu() -> None:
    """The derivative of a landing by its start velocity is the same on both devices, to 1e-6 of the largest entry."""
    found = []
    for device in ("cpu", "cuda"):
        setup = SCENES["chain-slope-drop"](worlds=2, device=device)
        simulator = Simulator(setup.scene, 0.02)
        v = setup.v.clone().requires_grad_()
        path = simulator.trajectory(simulator.initial_state(setup.q, v), steps=8)
        found.append(torch.autograd.grad(path.q[-1].sum(), v)[0].cpu())
    assert float((found[0] - found[1]).abs().max()) <= 1e-6 * float(found[0].abs().max())
