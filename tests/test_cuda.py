"""The same results on a CUDA device; skipped where there is none."""

from __future__ import annotations

import pytest
import torch

from pbfd_torch import Rollout, Simulator
from pbfd_torch.models import SCENES

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
