"""Contact with solids of the world, curved and moving: exact derivatives, slip relative to the solid, frames, worlds apart."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.contact.motion import Conveyor, Lift, Motion, Still, Turntable
from pbfd_torch.contact.obstacle import Obstacle
from pbfd_torch.contact.shapes import Box, Capsule, ConvexHull, Cylinder, Point, Shape, Solid, Sphere
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact import Contact, PreparedContact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.load import StepContext
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.tree.kinematics import place, retract
from pbfd_torch.tree.rotations import quaternion_exp, quaternion_matrix, quaternion_multiply
from tests.body_on_plane import contact_points, one_body, pose
from tests.finite_differences import jacobian, relative_error
from tests.random_trees import generator
from tests.states import state_of
from tests.term_cases import QUICK, ROUND, SLIDING, STICKING, Situation, colliders_of, no_load, situation
from tests.test_terms import moved_scene

TIME = 0.7  # at the start of the step: a moving solid is not where it was put
HULL = ConvexHull(0.8 * torch.randn(12, 3, dtype=torch.float64, generator=generator(5)).numpy())
SOLIDS: dict[str, Solid] = {
    "sphere": Sphere(0.7),
    "capsule": Capsule(0.5, 0.6),
    "box": Box((0.8, 0.6, 0.5)),
    "cylinder": Cylinder(0.6, 0.6),
    "hull": HULL,
}
CANDIDATES: dict[str, Sequence[Shape]] = {"points": (Point(), Box((0.1, 0.2, 0.05))), "round": (*ROUND, Point())}
LAWS: dict[str, FrictionLaw | None] = {
    "no friction": None,
    "sticking": STICKING,
    "sliding": SLIDING,
    "as printed": PbfdFriction.as_printed(5e4),
    "as derived": PbfdFriction.as_derived(5e4, 2.0, 0.5),
    "anchor, sticking": AnchoredFriction(0.7, 5.0),
    "anchor, sliding": AnchoredFriction(0.7, 1e-5),
}
MOTIONS: dict[str, Motion] = {
    "still": Still(),
    "turntable": Turntable(5.0, (0.3, -0.5, 1.0), (0.2, 0.1, -0.4)),
    "lift": Lift(lambda time: 0.4 * torch.sin(3 * time), (0.5, 0.2, -1.0)),
    "conveyor": Conveyor((2.0, -1.0, 0.5)),
}

all_solids = pytest.mark.parametrize("solid", SOLIDS)
all_motions = pytest.mark.parametrize("motion", MOTIONS)
all_candidates = pytest.mark.parametrize("candidates", CANDIDATES)


@dataclass(frozen=True, eq=False)
class Meeting:
    """A tree in the middle of a step, an obstacle that some of its candidates have pierced and some have not, and the contact of
    the two with what its anchors remember. The obstacle stands elsewhere in each world."""

    situation: Situation
    obstacle: Obstacle
    contact: Contact
    memory: Tensor

    def context(self, q: Tensor) -> StepContext:
        """The step's context for worlds like those of q."""
        return dataclasses.replace(self.situation.context(q), time=torch.full(q.shape[:-1], TIME, dtype=torch.float64))

    def prepared(self, q: Tensor) -> PreparedContact:
        return self.contact.recall(self.context(q), self.memory)

    def balance(self, q: Tensor) -> Balance:
        placement = place(self.situation.articulation, q)
        return Balance(placement, [no_load(placement), self.contact.load(self.prepared(q), placement)])


def meeting(
    seed: int, batch: tuple[int, ...], solid: str, motion: str, candidates: str, law: FrictionLaw | None, turn: float = 0.1,
    release: float = math.inf,
) -> Meeting:  # fmt: skip
    """Of many random places of the obstacle, each world gets one at which a quarter to three quarters of the candidates touch and
    none is near the border of touching."""
    s, random = situation(seed, batch, turn), generator(50 + seed)
    colliders = colliders_of(s.articulation, CANDIDATES[candidates])
    x, y, z, w = torch.randn(4, dtype=torch.float64, generator=random).tolist()
    tries = 400
    trial = Obstacle(
        "solid",
        SOLIDS[solid],
        0.8 * torch.randn(tries, *batch, 3, dtype=torch.float64, generator=random),
        (w, x, y, z),
        MOTIONS[motion],
    )
    placement = place(s.articulation, s.q)
    end = torch.tensor(TIME, dtype=torch.float64) + s.dt
    depth = Contact.between(s.articulation, colliders, trial, NormalForce(1e4, release=release), law).depth(placement, end)
    share = (depth > 0).double().mean(-1)
    clear = torch.where((share - 0.5).abs() <= 0.25, depth.abs().amin(-1), 0.0)
    assert isinstance(trial.position, Tensor)
    at = trial.position.gather(0, clear.argmax(0)[None, ..., None].expand(1, *batch, 3))[0]
    obstacle = dataclasses.replace(trial, position=at)
    made = Contact.between(s.articulation, colliders, obstacle, NormalForce(1e4, release=release), law)
    memory = 0.05 * torch.randn(made.memory(batch).shape, dtype=torch.float64, generator=random)
    return Meeting(s, obstacle, made, memory)


def jacobian_error(m: Meeting) -> float:
    """Relative error of the assembled Jacobian against central differences of the residual."""
    balance = m.balance(m.situation.q)
    expected = jacobian(m.situation.articulation, lambda q: m.balance(q).residual, m.situation.q)
    return relative_error(balance.jacobian, expected, floor=1e-3 * balance.residual.abs().amax(-1))


# Derivatives ----------------------------------------------------------------------------------------------------------


@all_solids
@all_motions
@all_candidates
def test_meetings_hold_what_the_cases_need(solid: str, motion: str, candidates: str) -> None:
    """In every world some candidates touch and some do not; those that touch slip by more than any sliding law needs."""
    m = meeting(0, (2,), solid, motion, candidates, STICKING)
    points = m.contact.points(m.prepared(m.situation.q), place(m.situation.articulation, m.situation.q))
    touching = points.depth > 0
    assert bool((touching.any(-1) & (~touching).any(-1)).all())
    assert float(torch.linalg.vector_norm(points.slip, dim=-1)[touching].min()) > 10 * SLIDING.slip_speed * float(m.situation.dt)


@all_solids
@all_candidates
@pytest.mark.parametrize("law", LAWS)
def test_jacobian_is_exact(solid: str, candidates: str, law: str) -> None:
    """J = ∂r/∂θ against central differences of r, ≤ 1e-7 relative, at a solid that turns."""
    assert jacobian_error(meeting(0, (2,), solid, "turntable", candidates, LAWS[law])) <= 1e-7


@all_solids
@all_motions
@pytest.mark.parametrize("seed", [1, 2])
def test_jacobian_is_exact_beside_moving_solids(solid: str, motion: str, seed: int) -> None:
    """As above on other trees for every motion, with links that turn by about a third of a radian over the step."""
    assert jacobian_error(meeting(seed, (2,), solid, motion, "round", STICKING, turn=0.3)) <= 1e-7


@all_solids
def test_jacobian_is_exact_where_contacts_let_go(solid: str) -> None:
    """As above with contacts that let go over the range of speeds of a random motion."""
    assert jacobian_error(meeting(0, (2,), solid, "turntable", "round", SLIDING, release=QUICK)) <= 1e-7


@all_solids
@all_candidates
def test_residual_and_jacobian_derive_from_the_energy(solid: str, candidates: str) -> None:
    """Without friction r = ∂E/∂δ and J = ∂²E/∂δ² of the stored energy, by automatic differentiation: ≤ 1e-10 relative."""
    m = meeting(1, (), solid, "lift", candidates, None)
    s, end = m.situation, torch.tensor(TIME, dtype=torch.float64) + m.situation.dt

    def energy(delta: Tensor) -> Tensor:
        return m.contact.potential(place(s.articulation, retract(s.articulation, s.q, delta)), end)

    at = torch.zeros(s.articulation.nv, dtype=torch.float64)
    gradient, hessian = torch.func.grad(energy)(at), torch.func.hessian(energy)(at)
    balance = m.balance(s.q)
    assert float((balance.residual - gradient).abs().max()) <= 1e-10 * float(gradient.abs().max())
    assert relative_error(balance.jacobian, hessian) <= 1e-10
    assert relative_error(balance.jacobian.mT, balance.jacobian) <= 1e-12


@all_solids
@pytest.mark.parametrize("law", ["sticking", "sliding", "anchor, sticking"])
def test_gradients_are_finite_where_nothing_moved(solid: str, law: str) -> None:
    """At zero slip and zero turn autograd through r is finite."""
    m = meeting(2, (2,), solid, "still", "round", LAWS[law])
    s = m.situation
    still = dataclasses.replace(m, situation=dataclasses.replace(s, state=state_of(s.q, s.q)), memory=torch.zeros_like(m.memory))
    prepared = still.prepared(s.q)
    q = s.q.clone().requires_grad_()
    placement = place(s.articulation, q)
    Balance(placement, [still.contact.load(prepared, placement)]).residual.square().sum().backward()
    assert q.grad is not None
    assert bool(torch.isfinite(q.grad).all())
    assert float(q.grad.abs().max()) > 0


# Frames and worlds ----------------------------------------------------------------------------------------------------


def seen_from(motion: Motion, rotation: Tensor, shift: Tensor) -> Motion:
    """A motion in another frame (p ← R p + t)."""

    def turned(vector: Sequence[float]) -> tuple[float, float, float]:
        x, y, z = (rotation @ torch.tensor(vector, dtype=torch.float64)).tolist()
        return x, y, z

    if isinstance(motion, Turntable):
        x, y, z = (torch.tensor(turned(motion.center), dtype=torch.float64) + shift).tolist()
        return dataclasses.replace(motion, axis=turned(motion.axis), center=(x, y, z))
    return dataclasses.replace(motion, direction=turned(motion.direction)) if isinstance(motion, Lift) else motion


@all_solids
@all_motions
def test_physics_does_not_depend_on_the_frame(solid: str, motion: str) -> None:
    """Turn and shift the whole scene, the obstacle and its motion included: r' = P r and J' = P J Pᵀ, P as in `moved_scene`."""
    m = meeting(2, (2,), solid, motion, "round", LAWS["anchor, sticking"])
    turn, shift = torch.tensor([0.7, -1.1, 0.4], dtype=torch.float64), torch.tensor([0.3, -2.0, 0.9], dtype=torch.float64)
    there, change, _ = moved_scene(m.situation, turn, shift)
    rotation = quaternion_matrix(quaternion_exp(turn))
    obstacle = dataclasses.replace(
        m.obstacle,
        position=torch.as_tensor(m.obstacle.position) @ rotation.mT + shift,
        quaternion=quaternion_multiply(quaternion_exp(turn), torch.as_tensor(m.obstacle.quaternion, dtype=torch.float64)),
        motion=seen_from(m.obstacle.motion, rotation, shift),
    )
    made = dataclasses.replace(m.contact, carrier=obstacle.carrier(torch.float64, torch.device("cpu")))
    here = m.balance(m.situation.q)
    moved = Meeting(there, obstacle, made, m.memory).balance(there.q)
    size = float(here.residual.abs().max())
    torch.testing.assert_close(moved.residual, here.residual @ change.mT, rtol=0, atol=1e-11 * size)
    assert relative_error(moved.jacobian, change @ here.jacobian @ change.mT) <= 1e-11


@all_solids
@all_motions
def test_worlds_are_apart(solid: str, motion: str) -> None:
    """A batch `[2, 2]` in which the obstacle stands elsewhere in each world gives what each world gives alone, by hand and by
    `take`; NaN in one world leaves the others bitwise as they were."""
    m = meeting(1, (2, 2), solid, motion, "round", LAWS["anchor, sticking"])
    s = m.situation
    whole = m.balance(s.q)
    size, stiff = float(whole.residual.abs().max()), float(whole.jacobian.abs().max())
    assert whole.residual.shape == (2, 2, s.articulation.nv)
    taken = Worlds((2, 2), torch.tensor([3, 1]))
    context = m.context(s.q).take(taken)
    some = place(context.previous.articulation, s.q.flatten(0, 1)[[3, 1]])
    contact = m.contact.take(taken)
    picked = Balance(some, [contact.load(contact.recall(context, taken.pick(m.memory, 2)), some)])
    for k, (i, j) in enumerate(((1, 1), (0, 1))):
        state = state_of(s.state.q[i, j], s.state.q_previous[i, j])
        a = dataclasses.replace(s.articulation, lower=s.articulation.lower[i, j], upper=s.articulation.upper[i, j])
        one = dataclasses.replace(s, articulation=a, state=state, q=s.q[i, j], control=None)
        obstacle = dataclasses.replace(m.obstacle, position=torch.as_tensor(m.obstacle.position)[i, j])
        made = dataclasses.replace(m.contact, carrier=obstacle.carrier(torch.float64, torch.device("cpu")))
        alone = Meeting(one, obstacle, made, m.memory[i, j]).balance(one.q)
        for found in (alone, Balance(some, picked.loads)):
            row = () if found is alone else (k,)
            torch.testing.assert_close(found.residual[row], whole.residual[i, j], rtol=0, atol=1e-13 * size)
            torch.testing.assert_close(found.jacobian[row], whole.jacobian[i, j], rtol=0, atol=1e-13 * stiff)
    q = s.q.clone()
    q[0, 1] = math.nan
    dirty = m.balance(q)
    for before, after in ((whole.residual, dirty.residual), (whole.jacobian, dirty.jacobian)):
        assert torch.equal(before[[0, 1, 1], [0, 0, 1]], after[[0, 1, 1], [0, 0, 1]])


# Slip beside a moving solid -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [Point(), Sphere(0.1), Box((0.1, 0.1, 0.1))], ids=lambda x: type(x).__name__)
@pytest.mark.parametrize("start", [0.0, 2.3])
@all_solids
@pytest.mark.parametrize("motion", ["turntable", "lift"])
def test_a_body_carried_along_does_not_slip(solid: str, motion: str, start: float, shape: Shape) -> None:
    """A body that moves rigidly with the solid from t to t + Δt: u = 0, so the force is along the normal, exactly."""
    articulation, base = one_body(shape, CoulombFriction(0.5))
    obstacle = Obstacle("solid", SOLIDS[solid], (0.1, 0.2, 0.3), (0.9, 0.1, -0.3, 0.2), MOTIONS[motion])
    carrier = obstacle.carrier(torch.float64, torch.device("cpu"))
    made = dataclasses.replace(base, surface=obstacle.surface(torch.float64, torch.device("cpu")), carrier=carrier)
    dt = torch.tensor(0.05, dtype=torch.float64)
    time = torch.tensor(start, dtype=torch.float64)
    relative = pose((0.3, 0.0, 0.35), (0.4, 0.2, -0.3))
    ends = []
    for at in (time, time + dt):
        frame = MOTIONS[motion].pose(at)
        turned = quaternion_multiply(_quaternion(frame[:3, :3]), relative[3:])
        ends.append(torch.cat((frame[:3, :3] @ relative[:3] + frame[:3, 3], turned)))
    state = dataclasses.replace(state_of(ends[0], ends[0]), time=time)
    prepared = made.prepare(ImplicitEuler().context(articulation, state, dt, torch.zeros(3, dtype=torch.float64), None))
    points = made.points(prepared, place(articulation, ends[1]))
    assert float(points.depth.max()) > 0
    assert float(points.slip.abs().max()) <= 1e-14
    off = points.force - (points.force * points.normal).sum(-1, keepdim=True) * points.normal
    assert float(off.abs().max()) <= 1e-9 * float(points.force.abs().max())


def _quaternion(rotation: Tensor) -> Tensor:
    """Unit quaternion of a rotation by less than half a turn, `[3, 3] → [4]`."""
    w = 0.5 * (1 + rotation.trace()).sqrt()
    axial = torch.stack((rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]))
    return torch.cat((w[None], axial / (4 * w)))


def test_slip_on_a_belt() -> None:
    """On a belt of velocity b in the frame of a turned box a body at rest slips by −b Δt; a body that moves at b does not slip, and
    neither does a sphere that turns in place with the surface under it, φ = −(n × b) Δt/ρ."""
    belt = Conveyor((1.5, 0.0, 0.0))
    quarter = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # the box's x is the world's y
    obstacle = Obstacle("belt", Box((2.0, 2.0, 0.5)), (0.0, 0.0, -0.5), quarter, belt)
    carrier = obstacle.carrier(torch.float64, torch.device("cpu"))
    for shape, height in ((Point(), -1e-3), (Sphere(0.1), 0.099)):
        articulation, base = one_body(shape, CoulombFriction(0.5))
        made = dataclasses.replace(base, surface=obstacle.surface(torch.float64, torch.device("cpu")), carrier=carrier)
        rest, along = pose((0.2, 0.1, height)), pose((0.2, 0.1 + 0.015, height))
        slips = [contact_points(articulation, made, rest, after, 0.01)[0].slip[0] for after in (rest, along)]
        torch.testing.assert_close(slips[0], torch.tensor([0.0, -0.015, 0.0], dtype=torch.float64), rtol=0, atol=1e-15)
        assert float(slips[1].abs().max()) <= 1e-15
        if height > 0:
            turned = pose((0.2, 0.1, height), (0.015 / 0.1, 0.0, 0.0))
            assert float(contact_points(articulation, made, rest, turned, 0.01)[0].slip.abs().max()) <= 1e-15
