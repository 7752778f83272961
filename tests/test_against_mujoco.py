"""Kinematics, dynamics and joint forces against MuJoCo (MJCF and URDF), and forward kinematics against pytorch-kinematics."""

from __future__ import annotations

import importlib.metadata
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from lxml import etree
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.balance.dynamics import bias_force, mass_matrix
from pbfd_torch.errors import NotModelledWarning
from pbfd_torch.loading import Robot, load_mjcf, load_urdf
from pbfd_torch.terms.joint_dry_friction import JointDryFriction
from pbfd_torch.terms.joint_springs import Armature, JointDamping, JointSprings, elastic_load
from pbfd_torch.terms.load import StepContext
from pbfd_torch.tree.kinematics import difference, place, retract

TOLERANCE = 1e-9
CONFIGURATIONS = 5
pytestmark = pytest.mark.filterwarnings("ignore::pbfd_torch.errors.NotModelledWarning", "ignore:.*triangle inequality")


@pytest.fixture(autouse=True)
def _no_log_file() -> Iterator[None]:
    """MuJoCo would log its warnings into the working directory."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    yield
    mujoco.set_mju_user_warning(before)


def installed(distribution: str, path: str) -> Path:
    """A file of an installed distribution, without importing it; skips the test where it is missing."""
    try:
        return Path(str(importlib.metadata.distribution(distribution).locate_file(path)))
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"{distribution}, whose robots this test loads, is not installed")


GYM = ["ant", "half_cheetah", "hopper", "humanoid", "humanoidstandup", "inverted_double_pendulum", "inverted_pendulum", "point"]
GYM += ["pusher", "pusher_v5", "reacher", "swimmer", "walker2d", "walker2d_v5"]
URDFS = {
    "a1": "a1_description/urdf/a1.urdf",
    "anymal_b": "anymal_b_simple_description/robots/anymal.urdf",
    "b1_z1": "b1_description/urdf/b1-z1.urdf",
    "baxter": "baxter_description/urdf/baxter.urdf",
    "bolt": "bolt_description/robots/bolt.urdf",
    "g1": "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    "go2": "go2_description/urdf/go2.urdf",
    "kinova": "kinova_description/robots/kinova.urdf",
    "panda": "panda_description/urdf/panda.urdf",
    "simple_humanoid": "simple_humanoid_description/urdf/simple_humanoid.urdf",
    "solo12": "solo_description/robots/solo12.urdf",
    "talos_reduced": "talos_data/robots/talos_reduced.urdf",
    "tiago_pro": "tiago_pro_description/robots/tiago_pro.urdf",
    "ur5": "ur_description/urdf/ur5_robot.urdf",
}


def mjcf_file(name: str) -> Path:
    if name == "joints":
        return Path(__file__).parent / "data" / "joints.xml"
    return installed("gymnasium", f"gymnasium/envs/mujoco/assets/{name}.xml")


def urdf_file(name: str) -> Path:
    return installed("example-robot-data", f"cmeel.prefix/share/example-robot-data/robots/{URDFS[name]}")


def quietly(load: Any, path: Path, **options: Any) -> Robot:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        robot: Robot = load(path, **options)
    return robot


def assert_close(ours: Tensor, theirs: NDArray[np.float64], scale: float | None = None) -> None:
    size = float(np.abs(theirs).max()) if scale is None else scale
    error = float(np.abs(ours.numpy() - theirs).max())
    assert error <= TOLERANCE * (size or 1.0), f"error {error:.3g} at size {size:.3g}"


# MJCF ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Pair:
    """One robot in both, with random configurations and velocities."""

    robot: Robot
    model: Any
    q: Tensor
    v: Tensor

    def states(self) -> list[Any]:
        """MuJoCo's data after the forward pass at each configuration and velocity."""
        found = []
        for q, v in zip(self.q.numpy(), self.v.numpy(), strict=True):
            data = mujoco.MjData(self.model)
            data.qpos[:], data.qvel[:] = q, v
            mujoco.mj_forward(self.model, data)
            found.append(data)
        return found

    @property
    def gravity(self) -> Tensor:
        return torch.tensor(self.robot.gravity, dtype=torch.float64)

    def term(self, kind: type) -> Any:
        return next((x for x in self.robot.joint_terms if isinstance(x, kind)), None)


@cache
def mjcf_pair(name: str) -> Pair:
    robot = quietly(load_mjcf, mjcf_file(name))
    model = mujoco.MjModel.from_xml_path(str(mjcf_file(name)))
    random = torch.Generator().manual_seed(7)
    q = retract(
        robot.articulation,
        robot.articulation.rest.expand(CONFIGURATIONS, -1),
        torch.randn(CONFIGURATIONS, robot.articulation.nv, generator=random, dtype=torch.float64),
    )
    return Pair(robot, model, q, torch.randn(CONFIGURATIONS, robot.articulation.nv, generator=random, dtype=torch.float64))


@pytest.fixture(params=["joints", *GYM])
def pair(request: pytest.FixtureRequest) -> Pair:
    return mjcf_pair(request.param)


def test_layout_and_reference(pair: Pair) -> None:
    articulation = pair.robot.articulation
    assert (articulation.nq, articulation.nv) == (pair.model.nq, pair.model.nv)
    assert_close(articulation.rest, pair.model.qpos0)


def test_poses(pair: Pair) -> None:
    poses = place(pair.robot.articulation, pair.q).poses
    states = pair.states()
    assert_close(poses[..., :3, 3], np.stack([d.xpos[1:] for d in states]), scale=1)
    assert_close(poses[..., :3, :3].flatten(-2), np.stack([d.xmat[1:] for d in states]))


def test_mass_matrix(pair: Pair) -> None:
    theirs = np.zeros((CONFIGURATIONS, pair.model.nv, pair.model.nv))
    for dense, data in zip(theirs, pair.states(), strict=True):
        mujoco.mj_fullM(pair.model, data, dense)
    assert_close(mass_matrix(pair.robot.articulation, pair.q, pair.robot.joint_terms), theirs)


def test_gravity_torque(pair: Pair) -> None:
    still = Pair(pair.robot, pair.model, pair.q, torch.zeros_like(pair.v))
    ours = bias_force(pair.robot.articulation, pair.q, still.v, pair.gravity)
    assert_close(ours, np.stack([d.qfrc_bias for d in still.states()]))


def test_bias_force(pair: Pair) -> None:
    ours = bias_force(pair.robot.articulation, pair.q, pair.v, pair.gravity)
    assert_close(ours, np.stack([d.qfrc_bias for d in pair.states()]))


def test_retract(pair: Pair) -> None:
    theirs = pair.q.numpy().copy()
    for q, v in zip(theirs, pair.v.numpy(), strict=True):
        mujoco.mj_integratePos(pair.model, q, v, 0.7)
    assert_close(retract(pair.robot.articulation, pair.q, 0.7 * pair.v), theirs)


def test_difference(pair: Pair) -> None:
    theirs = np.zeros((CONFIGURATIONS, pair.model.nv))
    for start, end, out in zip(pair.q.numpy(), pair.q.roll(1, 0).numpy(), theirs, strict=True):
        mujoco.mj_differentiatePos(pair.model, out, 1.0, start, end)
    assert_close(difference(pair.robot.articulation, pair.q, pair.q.roll(1, 0)), theirs)


def test_spring_force(pair: Pair) -> None:
    springs = pair.term(JointSprings)
    theirs = np.stack([d.qfrc_spring for d in pair.states()])
    if springs is None:
        assert not theirs.any()
    else:
        assert_close(-elastic_load(pair.robot.articulation, springs.stiffness, springs.rest, pair.q).residual, theirs)


def test_joint_coefficients(pair: Pair) -> None:
    damping, friction, armature = pair.term(JointDamping), pair.term(JointDryFriction), pair.term(Armature)
    zero = torch.zeros(pair.model.nv, dtype=torch.float64)
    theirs = np.stack([d.qfrc_damper for d in pair.states()])
    assert_close(-(damping.damping if damping else zero) * pair.v, theirs)
    assert_close(friction.torque if friction else zero, pair.model.dof_frictionloss)
    if not pair.model.actuator_armature.any():  # those of actuators are covered by the mass matrix
        assert_close(armature.inertia if armature else zero, pair.model.dof_armature)


def test_limits(pair: Pair) -> None:
    m = pair.model
    scalar = np.isin(m.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    lower, upper = np.full(m.nv, -np.inf), np.full(m.nv, np.inf)
    limited = scalar & m.jnt_limited.astype(bool)
    lower[m.jnt_dofadr[limited]], upper[m.jnt_dofadr[limited]] = m.jnt_range[limited].T
    np.testing.assert_array_equal(pair.robot.articulation.lower.numpy(), lower)
    np.testing.assert_array_equal(pair.robot.articulation.upper.numpy(), upper)


def test_actuator_force(pair: Pair) -> None:
    """At q_n = q − Δt v the implicit velocity of a servo is v."""
    actuators = pair.robot.actuators
    assert actuators is not None
    names = [mujoco.mj_id2name(pair.model, mujoco.mjtObj.mjOBJ_ACTUATOR, a) or f"actuator{a}" for a in range(pair.model.nactuator)]
    kept = [names.index(name) for name in actuators.names]
    control = 2 * torch.randn(CONFIGURATIONS, actuators.nu, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    states = pair.states()
    for data, u in zip(states, control.numpy(), strict=True):
        data.ctrl[:] = 0
        data.ctrl[kept] = u
        mujoco.mj_forward(pair.model, data)
    articulation = pair.robot.articulation
    dt = torch.tensor(1e-3, dtype=torch.float64)
    previous = place(articulation, retract(articulation, pair.q, -dt * pair.v))
    placement = place(articulation, pair.q)
    prepared = actuators.prepare(StepContext(dt, previous, dt, placement.poses, pair.q, control, 0 * dt, torch.zeros(3)))
    assert_close(-actuators.load(prepared, placement).residual, np.stack([d.qfrc_actuator for d in states]))


# URDF ---------------------------------------------------------------------------------------------------------------------


def mujoco_urdf(path: Path) -> Any:
    """MuJoCo's model of a URDF file, the base fixed and no link merged. Left out are shapes and the base's inertia, which may be
    zero: MuJoCo does not take that, and it moves nothing."""
    root = etree.parse(path, etree.XMLParser(remove_comments=True)).getroot()
    carried = {child.get("link") for child in root.findall("joint/child")}
    for link in root.findall("link"):
        for shape in link.findall("visual") + link.findall("collision"):
            link.remove(shape)
        if link.get("name") not in carried:
            for inertial in link.findall("inertial"):
                link.remove(inertial)
    compiler = {"fusestatic": "false", "discardvisual": "true", "balanceinertia": "false", "boundmass": "0"}
    etree.SubElement(etree.SubElement(root, "mujoco"), "compiler", compiler)
    return mujoco.MjModel.from_xml_string(etree.tostring(root, encoding="unicode"))


@dataclass(frozen=True, eq=False)
class UrdfPair:
    robot: Robot
    model: Any
    q: Tensor  # [CONFIGURATIONS, nq], our order of joints
    v: Tensor
    order: list[int]  # our joint of each of MuJoCo's

    def states(self) -> list[Any]:
        found = []
        for q, v in zip(self.q[:, self.order].numpy(), self.v[:, self.order].numpy(), strict=True):
            data = mujoco.MjData(self.model)
            data.qpos[:], data.qvel[:] = q, v
            mujoco.mj_forward(self.model, data)
            found.append(data)
        return found


@cache
def urdf_pair_of(name: str) -> UrdfPair:
    robot = quietly(load_urdf, urdf_file(name), free_base=False)
    model = mujoco_urdf(urdf_file(name))
    joints = [model.joint(j).name for j in range(model.njnt)]
    random = torch.Generator().manual_seed(9)
    q, v = torch.randn(2, CONFIGURATIONS, robot.articulation.nv, generator=random, dtype=torch.float64)
    return UrdfPair(robot, model, q, v, [robot.articulation.joint_index(x) for x in joints])


@pytest.fixture(params=URDFS)
def urdf_pair(request: pytest.FixtureRequest) -> UrdfPair:
    return urdf_pair_of(request.param)


def test_urdf_poses(urdf_pair: UrdfPair) -> None:
    articulation, model = urdf_pair.robot.articulation, urdf_pair.model
    assert len(urdf_pair.order) == articulation.nv
    bodies = [articulation.link_index(model.body(b).name) for b in range(1, model.nbody)]
    poses = place(articulation, urdf_pair.q).poses[:, bodies]
    states = urdf_pair.states()
    assert_close(poses[..., :3, 3], np.stack([d.xpos[1:] for d in states]), scale=1)
    assert_close(poses[..., :3, :3].flatten(-2), np.stack([d.xmat[1:] for d in states]))


def test_urdf_mass_matrix(urdf_pair: UrdfPair) -> None:
    theirs = np.zeros((CONFIGURATIONS, urdf_pair.model.nv, urdf_pair.model.nv))
    for dense, data in zip(theirs, urdf_pair.states(), strict=True):
        mujoco.mj_fullM(urdf_pair.model, data, dense)
    ours = mass_matrix(urdf_pair.robot.articulation, urdf_pair.q)
    assert_close(ours[:, urdf_pair.order][:, :, urdf_pair.order], theirs)


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_urdf_bias_force(urdf_pair: UrdfPair, speed: float) -> None:
    moving = UrdfPair(urdf_pair.robot, urdf_pair.model, urdf_pair.q, speed * urdf_pair.v, urdf_pair.order)
    gravity = torch.tensor(urdf_pair.robot.gravity, dtype=torch.float64)
    ours = bias_force(urdf_pair.robot.articulation, moving.q, moving.v, gravity)
    assert_close(ours[:, urdf_pair.order], np.stack([d.qfrc_bias for d in moving.states()]))


def test_urdf_joint_coefficients(urdf_pair: UrdfPair) -> None:
    terms = {type(x): x for x in urdf_pair.robot.joint_terms}
    zero = torch.zeros(urdf_pair.model.nv, dtype=torch.float64)
    damping = getattr(terms.get(JointDamping), "damping", zero)
    friction = getattr(terms.get(JointDryFriction), "torque", zero)
    assert_close(damping[urdf_pair.order], urdf_pair.model.dof_damping)
    assert_close(friction[urdf_pair.order], urdf_pair.model.dof_frictionloss)


def test_urdf_limits(urdf_pair: UrdfPair) -> None:
    articulation, model = urdf_pair.robot.articulation, urdf_pair.model
    limited = model.jnt_limited.astype(bool)
    ours = torch.stack((articulation.lower, articulation.upper), -1)[urdf_pair.order].numpy()
    np.testing.assert_array_equal(ours[limited], model.jnt_range[limited])
    assert not np.isfinite(ours[~limited]).any()


@pytest.mark.parametrize("name", URDFS)
def test_urdf_poses_of_pytorch_kinematics(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    """To 1e-5, since its numbers are 32-bit."""
    import pytorch_kinematics

    found = urdf_pair_of(name)
    articulation = found.robot.articulation
    chain = pytorch_kinematics.build_chain_from_urdf(urdf_file(name).read_bytes()).to(dtype=torch.float64)
    frames = chain.forward_kinematics(found.q[:, [articulation.joint_index(x) for x in chain.get_joint_parameter_names()]])
    poses = place(articulation, found.q).poses
    for link, frame in frames.items():
        theirs = frame.get_matrix()  # one for all where nothing moves it
        torch.testing.assert_close(poses[:, articulation.link_index(link)], theirs.expand(CONFIGURATIONS, 4, 4), rtol=0, atol=1e-5)
    capfd.readouterr()  # its parser prints what it does not know


def test_a_warning_names_file_and_feature() -> None:
    with pytest.warns(NotModelledWarning, match=r"swimmer\.xml: not modelled: fluid forces"):
        load_mjcf(mjcf_file("swimmer"))
