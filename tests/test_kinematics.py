"""Poses, motion axes, rates, retract and difference: by hand, by an independent recursion, by differences, in any batch shape."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link, homogeneous
from pbfd_torch.tree.kinematics import Motion, difference, link_jacobians, place, retract
from pbfd_torch.tree.rotations import quaternion_matrix, skew
from tests.finite_differences import derivative
from tests.random_trees import SEEDS, generator, moved_q, random_links, random_q, random_tree

HINGE, SLIDE, BALL, FREE = JointKind.HINGE, JointKind.SLIDE, JointKind.BALL, JointKind.FREE
all_trees = pytest.mark.parametrize("seed", SEEDS)
BATCHES: list[tuple[int, ...]] = [(), (3,), (2, 3)]
all_batches = pytest.mark.parametrize("batch", BATCHES, ids=str)


def tangent(articulation: Articulation, seed: int, batch: tuple[int, ...] = (), size: float = 1.0) -> Tensor:
    return size * torch.randn(*batch, articulation.nv, dtype=torch.float64, generator=generator(seed))


# Poses ----------------------------------------------------------------------------------------------------------------


def test_two_link_arm() -> None:
    """Links of length 1 and ½ on hinges about z: the elbow is at (cos a, sin a), the tip at elbow + ½ (cos(a + b), sin(a + b))."""
    z = (0.0, 0.0, 1.0)
    inertia = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))
    arm = Articulation.from_links(
        [
            Link("upper", joints=(Joint("shoulder", HINGE, z),), mass=1.0, inertia=inertia),
            Link("lower", "upper", (1.0, 0.0, 0.0), joints=(Joint("elbow", HINGE, z),), mass=1.0, inertia=inertia),
            Link("hand", "lower", (0.5, 0.0, 0.0)),
        ]
    )
    a, b = 0.3, -1.1
    placement = place(arm, torch.tensor([a, b], dtype=torch.float64))
    elbow = [math.cos(a), math.sin(a), 0.0]
    tip = [elbow[0] + 0.5 * math.cos(a + b), elbow[1] + 0.5 * math.sin(a + b), 0.0]
    positions = placement.poses[:, :3, 3].tolist()
    for found, expected in zip(positions, ([0.0, 0.0, 0.0], elbow, tip), strict=True):
        assert found == pytest.approx(expected, abs=1e-15)
    c, s = math.cos(a + b), math.sin(a + b)
    expected_turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(placement.poses[2, :3, :3], expected_turn, rtol=0, atol=1e-15)
    # a hinge about z at the elbow moves the tip by z × (tip − elbow)
    twist = placement.axes[1]
    tip_velocity = twist[3:] + torch.linalg.cross(twist[:3], torch.tensor(tip, dtype=torch.float64))
    assert tip_velocity.tolist() == pytest.approx([-0.5 * s, 0.5 * c, 0.0], abs=1e-15)


def _joint_motion(joint: Joint, q: Tensor) -> Tensor:
    """4×4 motion of one joint at its own coordinates, by matrix exponentials."""
    anchor, back = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    anchor[:3, 3] = torch.tensor(joint.anchor, dtype=torch.float64)
    back[:3, 3] = -anchor[:3, 3]
    motion = torch.eye(4, dtype=torch.float64)
    axis = torch.tensor(joint.axis, dtype=torch.float64)
    axis = axis / torch.linalg.vector_norm(axis)
    if joint.kind is HINGE:
        motion[:3, :3] = torch.linalg.matrix_exp(skew(axis) * (q[0] - joint.ref))
    elif joint.kind is SLIDE:
        motion[:3, 3] = axis * (q[0] - joint.ref)
    else:
        motion[:3, :3] = quaternion_matrix(q)
    return anchor @ motion @ back


def recursive_poses(links: list[Link], q: Tensor) -> Tensor:
    """World poses of the links from their description, one joint after another: T_parent · placement · Π motions."""
    poses: dict[str, Tensor] = {"": torch.eye(4, dtype=torch.float64)}
    start = 0
    for link in links:
        turn = quaternion_matrix(torch.tensor(link.quaternion, dtype=torch.float64))
        pose = poses[link.parent] @ homogeneous(turn, torch.tensor(link.position, dtype=torch.float64))
        for joint in link.joints:
            own = q[start : start + joint.kind.nq]
            start += joint.kind.nq
            pose = homogeneous(quaternion_matrix(own[3:]), own[:3]) if joint.kind is FREE else pose @ _joint_motion(joint, own)
        poses[link.name] = pose
    return torch.stack([poses[link.name] for link in links])


@all_trees
def test_poses_follow_from_the_description(seed: int) -> None:
    """T = T_parent · [placement] · Π [anchor] J(q − ref) [anchor]⁻¹ for every link, all joint kinds, anchors and refs."""
    links = random_links(seed)
    articulation = Articulation.from_links(links)
    q = random_q(articulation, seed)
    torch.testing.assert_close(place(articulation, q).poses, recursive_poses(links, q), rtol=0, atol=1e-13)


@all_trees
def test_rest_is_the_reference_placement(seed: int) -> None:
    """At q = rest every link stands where `position` and `quaternion` put it."""
    links = random_links(seed)
    articulation = Articulation.from_links(links)
    poses: dict[str, Tensor] = {"": torch.eye(4, dtype=torch.float64)}
    for link in links:
        turn = quaternion_matrix(torch.tensor(link.quaternion, dtype=torch.float64))
        poses[link.name] = poses[link.parent] @ homogeneous(turn, torch.tensor(link.position, dtype=torch.float64))
    expected = torch.stack([poses[link.name] for link in links])
    torch.testing.assert_close(place(articulation, articulation.rest).poses, expected, rtol=0, atol=1e-13)


@all_trees
def test_poses_are_rigid(seed: int) -> None:
    """RᵀR = 1, det R = 1, last row (0, 0, 0, 1), far from the rest configuration as well."""
    articulation = random_tree(seed)
    poses = place(articulation, random_q(articulation, seed, (10,))).poses
    turns = poses[..., :3, :3]
    eye = torch.eye(3, dtype=torch.float64)
    assert float((turns.mT @ turns - eye).abs().max()) <= 1e-13
    assert float((torch.linalg.det(turns) - 1).abs().max()) <= 1e-13
    assert torch.equal(poses[..., 3, :], torch.eye(4, dtype=torch.float64)[3].expand(10, articulation.nlink, 4))


# Derivatives of poses -------------------------------------------------------------------------------------------------


def twist_matrices(twists: Tensor) -> Tensor:
    """[s] with Ṫ = [s] T, the upper three rows `[*, 3, 4]`."""
    return torch.cat((skew(twists[..., :3]), twists[..., 3:, None]), -1)


@all_trees
def test_axes_are_the_derivatives_of_the_poses(seed: int) -> None:
    """∂T_b/∂δ_i = [s_i] T_b where dof i moves link b and 0 elsewhere, by central differences of poses along q ⊕ δ."""
    articulation = random_tree(seed)
    q = random_q(articulation, seed, (2,))
    placement = place(articulation, q)

    def poses(delta: Tensor) -> Tensor:
        return place(articulation, retract(articulation, q, delta)).poses[..., :3, :]

    found = derivative(poses, articulation.nv, (2,))  # [2, nlink, 3, 4, nv]
    jacobians = link_jacobians(placement)  # [2, nlink, 6, nv]
    expected = twist_matrices(jacobians.mT) @ placement.poses[..., None, :, :]  # [2, nlink, nv, 3, 4]
    assert float((expected.movedim(-3, -1) - found).abs().max()) <= 1e-9
    moves = articulation.topology.moves_link
    torch.testing.assert_close(jacobians.mT, placement.axes[:, None] * moves[..., None], rtol=0, atol=0)


@all_trees
@all_batches
def test_motion(seed: int, batch: tuple[int, ...]) -> None:
    """Along q(t) = q ⊕ t v: twist = Σ s_i v_i = J v, Ṫ = [twist] T, and T̈ at v̇ = 0, by central differences in t."""
    articulation = random_tree(seed)
    q, v = random_q(articulation, seed, batch), tangent(articulation, seed, batch)
    placement = place(articulation, q)
    motion = Motion(placement, v)
    twists, velocity, second = motion.twists, motion.rates, motion.accelerations
    torch.testing.assert_close(twists, (link_jacobians(placement) @ v[..., None, :, None]).squeeze(-1), rtol=0, atol=1e-12)
    torch.testing.assert_close(velocity, twist_matrices(twists) @ placement.poses, rtol=0, atol=1e-12)

    def poses(t: Tensor) -> Tensor:
        return place(articulation, retract(articulation, q, t * v)).poses[..., :3, :]

    def rates(t: Tensor) -> Tensor:
        return Motion(place(articulation, retract(articulation, q, t * v)), v.expand(*t.shape[:-1], -1)).rates

    assert float((derivative(poses, 1, batch).squeeze(-1) - velocity).abs().max()) <= 1e-9
    scale = float(second.abs().max())
    assert float((derivative(rates, 1, batch).squeeze(-1) - second).abs().max()) <= 1e-9 * scale


# The manifold ---------------------------------------------------------------------------------------------------------


@all_trees
@all_batches
def test_difference_inverts_retract(seed: int, batch: tuple[int, ...]) -> None:
    """difference(q, q ⊕ δ) = δ for turns below π, and q ⊕ difference(q, q') = q' up to the sign of quaternions."""
    articulation = random_tree(seed)
    q = random_q(articulation, seed, batch)
    delta = tangent(articulation, seed, batch)
    rows = articulation.topology.turning_v
    delta[..., rows] *= (3.0 / torch.linalg.vector_norm(delta[..., rows], dim=-1, keepdim=True)).clamp_max(1.0)
    moved = retract(articulation, q, delta)
    torch.testing.assert_close(difference(articulation, q, moved), delta, rtol=0, atol=1e-13)
    assert torch.equal(q, random_q(articulation, seed, batch))  # retract left its argument alone
    end = random_q(articulation, seed + 50, batch)
    reached = retract(articulation, q, difference(articulation, q, end))
    torch.testing.assert_close(place(articulation, reached).poses, place(articulation, end).poses, rtol=0, atol=1e-12)


@all_trees
def test_retract_keeps_quaternions_at_unit_norm(seed: int) -> None:
    """‖q‖ = 1 after 200 retractions, to rounding; zero moves leave q in place."""
    articulation = random_tree(seed)
    q = random_q(articulation, seed)
    torch.testing.assert_close(retract(articulation, q, torch.zeros(articulation.nv, dtype=torch.float64)), q, rtol=0, atol=1e-15)
    for k in range(200):
        q = moved_q(articulation, q, k, 0.5)
    norms = torch.linalg.vector_norm(q[articulation.topology.turning_q], dim=-1)
    assert float((norms - 1).abs().max()) <= 1e-15


def test_tangent_directions_are_what_the_docs_say() -> None:
    """Free joint: translation along world axes, rotation about the body's own axes. Ball: rotation about the link's own axes."""
    body = Articulation.from_links(
        [Link("b", joints=(Joint("f", FREE),), mass=1.0, inertia=((0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1)))]
    )
    q = random_q(body, 3)
    turn = place(body, q).poses[0, :3, :3]
    step = torch.tensor([0.1, 0.2, 0.3, 0.0, 0.0, 0.4], dtype=torch.float64)
    after = place(body, retract(body, q, step)).poses[0]
    torch.testing.assert_close(after[:3, 3] - q[:3], step[:3])
    torch.testing.assert_close(after[:3, :3], turn @ torch.linalg.matrix_exp(skew(step[3:])), rtol=0, atol=1e-14)
    axes = place(body, q).axes
    torch.testing.assert_close(axes[3:, :3], turn.mT, rtol=0, atol=1e-15)  # row i: the body's axis i in world coordinates


def test_difference_takes_the_short_way() -> None:
    """Angles of a ball joint's difference lie in [0, π] whichever sign its quaternions have; hinges do not wrap."""
    articulation = random_tree(0)
    q, end = random_q(articulation, 1, (100,)), random_q(articulation, 2, (100,))
    gap = difference(articulation, q, end)
    angles = torch.linalg.vector_norm(gap[..., articulation.topology.turning_v], dim=-1)
    assert float(angles.max()) <= math.pi + 1e-12
    flipped = end.clone()
    flipped[..., articulation.topology.turning_q] *= -1
    torch.testing.assert_close(difference(articulation, q, flipped), gap, rtol=0, atol=0)
    x = articulation.topology.scalar_q
    wound = q.clone()
    wound[..., x] += 2 * math.pi
    torch.testing.assert_close(
        difference(articulation, q, wound)[..., articulation.topology.scalar_v],
        torch.full((100, len(x)), 2 * math.pi, dtype=torch.float64),
    )


# Batches, precision, gradients ----------------------------------------------------------------------------------------


@all_batches
def test_batch_equals_its_worlds(batch: tuple[int, ...]) -> None:
    """place, axes and retract of a batch are those of every world alone, bitwise."""
    articulation = random_tree(1)
    q, delta = random_q(articulation, 4, batch), tangent(articulation, 4, batch)
    whole, moved = place(articulation, q), retract(articulation, q, delta)
    assert whole.poses.shape == (*batch, articulation.nlink, 4, 4)
    assert whole.axes.shape == (*batch, articulation.nv, 6)
    rows = zip(q.view(-1, articulation.nq), delta.reshape(-1, articulation.nv), strict=True)
    for k, (one_q, one_delta) in enumerate(rows):
        alone = place(articulation, one_q)
        assert torch.equal(whole.poses.view(-1, articulation.nlink, 4, 4)[k], alone.poses)
        assert torch.equal(whole.axes.view(-1, articulation.nv, 6)[k], alone.axes)
        assert torch.equal(moved.view(-1, articulation.nq)[k], retract(articulation, one_q, one_delta))


@pytest.mark.parametrize("batch", [(3,), (2, 3)], ids=str)
@pytest.mark.parametrize("shared_q", [True, False], ids=["one q", "q per world"])
def test_parameters_may_differ_from_world_to_world(batch: tuple[int, ...], shared_q: bool) -> None:
    """Frames, axes, refs and pseudo-inertias `[*batch, …]` broadcast against q, `[nq]` or `[*batch, nq]`."""
    articulation = random_tree(2)
    random = generator(8)

    def varied(value: Tensor, size: float) -> Tensor:
        return value + size * torch.randn(*batch, *value.shape, dtype=torch.float64, generator=random)

    shift = torch.zeros(*batch, articulation.nlink, 4, 4, dtype=torch.float64)
    shift[..., :3, 3] = 0.1 * torch.randn(*batch, articulation.nlink, 3, dtype=torch.float64, generator=random)
    joint_shift = torch.zeros(*batch, articulation.topology.njoint, 4, 4, dtype=torch.float64)
    joint_shift[..., :3, 3] = 0.1 * torch.randn(*batch, articulation.topology.njoint, 3, dtype=torch.float64, generator=random)
    axis = varied(articulation.joint_axis, 0.3)
    scale = 1 + torch.rand(*batch, 1, 1, 1, dtype=torch.float64, generator=random)
    changed = {
        "joint_frame": articulation.joint_frame + joint_shift,
        "joint_axis": axis / torch.linalg.vector_norm(axis, dim=-1, keepdim=True),
        "joint_ref": varied(articulation.joint_ref, 0.2),
        "link_frame": articulation.link_frame + shift,
        "pseudo_inertia": articulation.pseudo_inertia * scale,
    }
    many = dataclasses.replace(articulation, **changed)
    q = random_q(articulation, 5, () if shared_q else batch)
    v = tangent(articulation, 6, batch)
    whole = place(many, q)
    assert whole.poses.shape == (*batch, articulation.nlink, 4, 4)
    motion = Motion(whole, v)
    for index in torch.cartesian_prod(*(torch.arange(n) for n in batch)).view(-1, len(batch)).tolist():
        at = tuple(index)
        one = dataclasses.replace(articulation, **{name: value[at] for name, value in changed.items()})
        alone = place(one, q if shared_q else q[at])
        torch.testing.assert_close(whole.poses[at], alone.poses, rtol=0, atol=1e-15)
        torch.testing.assert_close(whole.axes[at], alone.axes, rtol=0, atol=1e-15)
        torch.testing.assert_close(motion.rates[at], Motion(alone, v[at]).rates, rtol=0, atol=1e-12)
        torch.testing.assert_close(motion.accelerations[at], Motion(alone, v[at]).accelerations, rtol=0, atol=1e-12)


@all_trees
def test_single_precision_agrees(seed: int) -> None:
    """float32 poses and axes agree with float64 to 1e-5 (m, and 1 for rotations)."""
    articulation = random_tree(seed)
    q = random_q(articulation, seed, (5,))
    exact, rough = place(articulation, q), place(articulation.to(torch.float32), q.float())
    assert rough.poses.dtype == torch.float32
    assert rough.axes.dtype == torch.float32
    assert float((rough.poses - exact.poses).abs().max()) <= 1e-5
    assert float((rough.axes - exact.axes).abs().max()) <= 1e-5
    delta = tangent(articulation, seed, (5,))
    moved = retract(articulation.to(torch.float32), q.float(), delta.float())
    assert moved.dtype == torch.float32
    assert float((moved - retract(articulation, q, delta)).abs().max()) <= 1e-5


@pytest.mark.parametrize("at_rest", [True, False], ids=["zero rotation", "random"])
@pytest.mark.parametrize("seed", SEEDS[:2])
def test_gradients_of_poses(seed: int, at_rest: bool) -> None:
    """Poses and axes differentiate by q, joint_frame, joint_axis, joint_ref and link_frame: automatic = central differences."""
    articulation = random_tree(seed)
    q = articulation.rest if at_rest else random_q(articulation, seed)

    def outputs(q: Tensor, frame: Tensor, axis: Tensor, ref: Tensor, link: Tensor) -> tuple[Tensor, Tensor]:
        moved = dataclasses.replace(articulation, joint_frame=frame, joint_axis=axis, joint_ref=ref, link_frame=link)
        placement = place(moved, q)
        return placement.poses, placement.axes

    a = articulation
    inputs = [x.clone().requires_grad_() for x in (q, a.joint_frame, a.joint_axis, a.joint_ref, a.link_frame)]
    assert torch.autograd.gradcheck(outputs, inputs, atol=1e-7, fast_mode=True)


@pytest.mark.parametrize("size", [0.0, 0.7], ids=["zero move", "random"])
def test_gradients_of_retract_and_difference(size: float) -> None:
    """retract by q and δ, difference by both ends, at δ = 0 as well; retract ∘ difference has the identity as its derivative."""
    articulation = random_tree(0)
    q = random_q(articulation, 0).requires_grad_()
    delta = tangent(articulation, 0, (), size).requires_grad_()
    assert torch.autograd.gradcheck(lambda a, b: retract(articulation, a, b), (q, delta), atol=1e-7)

    def there(delta: Tensor) -> Tensor:
        start = q.detach()
        return difference(articulation, start, retract(articulation, start, delta))

    identity = torch.func.jacrev(there)(delta.detach())
    assert float((identity - torch.eye(articulation.nv, dtype=torch.float64)).abs().max()) <= 1e-12


def test_forward_mode_sees_the_parameters() -> None:
    """Forward-mode and reverse-mode derivatives by a joint's axis and frame agree: no cached value hides them."""
    articulation = random_tree(1)
    q = random_q(articulation, 1)
    place(articulation, q)  # fills the cache

    def poses(frame: Tensor, axis: Tensor) -> Tensor:
        return place(dataclasses.replace(articulation, joint_frame=frame, joint_axis=axis), q).poses

    inputs = (articulation.joint_frame, articulation.joint_axis)
    tangents = tuple(torch.randn(x.shape, dtype=torch.float64, generator=generator(9)) for x in inputs)
    _, forward, *_ = torch.func.jvp(poses, inputs, tangents)
    _, backward = torch.autograd.functional.jvp(poses, inputs, tangents)
    assert float(backward.abs().max()) > 0.1
    torch.testing.assert_close(forward, backward, rtol=0, atol=1e-12)
