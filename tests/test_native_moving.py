"""Obstacles that move, in the compiled core: the reference's forces and derivatives beside them wherever they are, its steps from
any time on, halved ones too, its records; and a world goes its way whatever the times of the others are."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from pbfd_torch import Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.motion import Lift, Motion, Turntable
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Cylinder
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.solvers.objective import Status
from pbfd_torch.solvers.per_world import mapped
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.tree.kinematics import retract
from tests.native_moving import MOTIONS, SCHEMES, drawn, over, table, thrown, timed
from tests.native_parity import DT, require_balance, require_starts, resting
from tests.native_piles import SHAPES
from tests.test_native_anchors import anchored, require_kept, stretched
from tests.test_native_contact import BALLS, CONVEX, CURVED, GROUND, SOLIDS, beside, require_touching, touching
from tests.test_native_fallbacks import require_equal

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

PLANE = {"plane": HalfSpace("plane", (0.1, -0.2, 0.9), -0.1)}
BESIDE: list[tuple[str, Any]] = [(name, Contact) for name in (PLANE | SOLIDS)]
BESIDE += [(name, CurvedContact) for name in sorted((PLANE | SOLIDS).keys() - CONVEX.keys())]


def placed(solid: Any, worlds: int, motion: Motion) -> Any:
    """The solid in motion, elsewhere in each world if it is an obstacle."""
    if isinstance(solid, HalfSpace):
        return dataclasses.replace(solid, motion=motion)
    position, quaternion = torch.tensor(solid.position).double(), torch.tensor(solid.quaternion).double()
    moved = position + 0.1 * drawn(worlds, 3, seed=3), quaternion + 0.1 * drawn(worlds, 4, seed=4)
    return dataclasses.replace(solid, position=moved[0], quaternion=moved[1], motion=motion)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize(("solid", "kind"), BESIDE)
def test_candidates_beside_solids(solid: str, kind: Any, motion: str) -> None:
    """Forces and derivatives, at other times in each world."""
    worlds = 60
    moving = placed((PLANE | SOLIDS)[solid], worlds, MOTIONS[motion])
    scene = touching(BALLS if kind is Contact else CURVED, (moving, GROUND), kind)
    state, q = beside(scene, worlds, time=drawn(worlds, seed=5) + 1)
    require_touching(scene, state, q)
    require_balance(scene, state, q)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize(("solid", "kind"), BESIDE)
def test_anchors_are_carried_along(solid: str, kind: Any, motion: str) -> None:
    """Forces and derivatives with what anchors remember, and what they remember after a step."""
    worlds = 24
    moving = placed((PLANE | SOLIDS)[solid], worlds, MOTIONS[motion])
    scene = anchored(touching(BALLS if kind is Contact else CURVED, (moving, GROUND), kind))
    state, q = beside(scene, worlds, time=drawn(worlds, seed=5) + 1)
    state = stretched(scene, state)
    require_balance(scene, state, q)
    native = NativeStepper(Simulator(scene, DT).eager)
    after, solution, _ = native.made(state, None)
    assert require_kept(native, state, None, after, solution) >= 15
    assert max(float(x.abs().max()) for x in after.memory) > 1e-4


@pytest.mark.parametrize("solid", CONVEX)
def test_fast_balls_do_not_pass_through(solid: str) -> None:
    worlds = 60
    scene = touching(BALLS, (placed(CONVEX[solid], worlds, MOTIONS["rocking"]),))
    state, q = beside(scene, worlds, speed=10.0, time=drawn(worlds, seed=5) + 1)
    prepared = Simulator(scene, DT).eager.objective(state).prepared[1]
    assert 0.2 < float(prepared.surface.passed.double().mean()) < 0.8
    require_balance(scene, state, q)


def crowd(motion: Motion, shapes: str = "boxes", worlds: int = 0, **kwargs: Any) -> Scene:
    """Bodies on a table that moves, beside obstacles that move in another way and one that does not."""
    block = Obstacle("block", Box((0.2, 0.2, 0.1)), (0.3, 0.2, 0.0), motion=Lift.steady((-0.5, 0.3, 0.2)))
    wheel = Obstacle("wheel", Box((0.15, 0.2, 0.1)), (-0.3, -0.1, 0.0), motion=Turntable(2.0, (0.0, 1.0, 0.3), (-0.3, 0.0, 0.0)))
    still = Obstacle("still", Box((0.1, 0.1, 0.1)), (0.0, 0.3, 0.0))
    own = (0.1 * drawn(worlds, 3, seed=8) + torch.tensor([0.0, 0.0, -0.1]),) if worlds else ()
    return over(SHAPES[shapes], (table(motion, Box((0.6, 0.5, 0.1)), *own), block, wheel, still), **kwargs)


@pytest.mark.parametrize("shapes", SHAPES)
@pytest.mark.parametrize("motion", MOTIONS)
def test_bodies_on_obstacles(motion: str, shapes: str) -> None:
    """Several at once; where the table begins elsewhere in each world too, as far as the core knows that of one at rest."""
    worlds = 60
    starts = [0] if motion == "conveyor" else [0, worlds]
    for own in starts:
        scene = crowd(MOTIONS[motion], shapes, own)
        q, v = thrown(scene, worlds)
        state = timed(resting(q, v), drawn(worlds, seed=2) + 1)
        end = retract(scene.articulation, q, DT * v)
        require_touching(scene, state, end)
        require_balance(scene, state, end)
