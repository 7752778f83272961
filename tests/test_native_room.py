"""The memory that the compiled core works in may hold anything when a call begins."""

from __future__ import annotations

import pytest
import torch

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.integrators.named import INTEGRATORS
from pbfd_torch.models import SCENES
from pbfd_torch.native.calls import Calls
from pbfd_torch.native.library import library
from pbfd_torch.tensors.structures import tensors_of
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_springs import Armature
from pbfd_torch.terms.pushes import Pushes

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")


def massless_leaf() -> Scene:
    """A last link that only its armature holds back, and a push on it."""
    links = [
        Link("base", joints=(Joint("good", JointKind.HINGE),), mass=1.0, inertia=((0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1))),
        Link("tool", "base", joints=(Joint("loose", JointKind.BALL),)),
    ]
    articulation = Articulation.from_links(links)
    armature = torch.full((articulation.nv,), 0.01, dtype=torch.float64)
    pushes = Pushes.at_centers(articulation, torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64))
    gravity = torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
    return Scene(articulation, (Inertia(), Armature(armature), pushes), gravity)


@pytest.fixture
def filled(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """What each byte of that memory holds when a call begins: `byte`."""
    held = {"byte": 0}
    room = Calls._room

    def of_this(calls: Calls) -> object:
        found = room(calls)
        found._memory.fill_(held["byte"])
        return found

    monkeypatch.setattr(Calls, "_room", of_this)
    return held


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", ["massless leaf", "hopper", "chain-ground", "quadruped"])
def test_nothing_is_read_before_it_is_written(name: str, integrator: str, filled: dict[str, int]) -> None:
    """Starts, steps and their record are the same bits after zeros, after ones and after NaNs (bytes 255)."""
    scene = massless_leaf() if name == "massless leaf" else SCENES[name](worlds=3).scene
    q = None if name == "massless leaf" else SCENES[name](worlds=3).q
    ends = []
    for filled["byte"] in (0, 1, 255):
        simulator = Simulator(scene, 0.01, INTEGRATORS[integrator]())
        rollout = simulator.rollout(simulator.initial_state(q), steps=4)
        assert simulator.engine == "native", simulator.engine_reason
        assert bool(rollout.solved.all())
        ends.append(tensors_of(rollout))
    for others in ends[1:]:
        for one, other in zip(ends[0], others, strict=True):
            assert torch.equal(one.nan_to_num(), other.nan_to_num())
