"""Hands at work: a gripper that pinches a capsule, and an arm with mesh links that sweeps a table."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import torch

from pbfd_torch.contact.shapes import Box, Capsule, Collider
from pbfd_torch.loading import load_robot
from pbfd_torch.loading.scene import robot_scene
from pbfd_torch.models.setup import Metric, Setup, repeated
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.anchored_friction import AnchoredFriction
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link

GRAVITY = 9.81
GRIP, OBJECT_MASS, FINGER_MASS = 12.0, 0.045, 0.2  # [N] of each finger, [kg]
PAD = (0.01, 0.03, 0.03)  # half extents of a finger [m]
RADIUS, HALF_LENGTH = 0.015, 0.03  # of the capsule [m]
STIFFNESS = 1e8
TURN, SHOULDER, ELBOW, WRIST = 0.0, 0.95, 1.35, 0.8  # where the arm starts [rad]: reaching down to the table


def gripper(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """Two fingers pinch a capsule of 45 g between flat pads with 12 N each, μ = 1, friction with anchors: it does not slide."""
    across = OBJECT_MASS * (3 * RADIUS**2 + (2 * HALF_LENGTH) ** 2) / 12
    along = OBJECT_MASS * RADIUS**2 / 2
    inertia = ((across, 0.0, 0.0), (0.0, across, 0.0), (0.0, 0.0, along))
    small = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4))
    reach = RADIUS + PAD[0] - math.sqrt(GRIP / 2 / STIFFNESS)  # two points carry each finger's force
    links = [
        Link(
            f"finger{k}",
            position=(side * reach, 0.0, 0.0),
            joints=(Joint(f"slide{k}", JointKind.SLIDE, (1.0, 0.0, 0.0)),),
            mass=FINGER_MASS,
            inertia=small,
        )
        for k, side in enumerate((-1.0, 1.0))
    ]  # fmt: skip
    links.append(Link("capsule", joints=(Joint("free", JointKind.FREE),), mass=OBJECT_MASS, inertia=inertia))
    articulation = Articulation.from_links(links, dtype, device)
    colliders = [Collider(f"pad{k}", f"finger{k}", Box(PAD)) for k in range(2)]
    colliders.append(Collider("capsule", "capsule", Capsule(RADIUS, HALF_LENGTH)))
    drives = Actuators.from_list(articulation, [Actuator.motor(f"press{k}", f"slide{k}") for k in range(2)])
    contacts = contact_terms(articulation, colliders, (), ContactRules(NormalForce(STIFFNESS), AnchoredFriction(1.0)))
    gravity = torch.tensor([0.0, 0.0, -GRAVITY], dtype=dtype, device=device)
    scene = Scene(articulation, (Inertia(), drives, *contacts), gravity, colliders, (), "gripper")
    q = repeated(articulation.rest, worlds)

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        moved = torch.linalg.vector_norm(rollout.link_poses[-1, :, 2, :, 3] - rollout.link_poses[0, :, 2, :, 3], dim=-1)
        return {"slid_m": moved.tolist(), "final_speed_m_s": torch.linalg.vector_norm(rollout.v[-1, :, 2:5], dim=-1).tolist()}

    control = q.new_tensor([GRIP, -GRIP])
    return Setup(scene, q, q.new_zeros(worlds, articulation.nv), 60.0, 0.02, report, control=control)


def robot_arm(worlds: int = 1, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Setup:
    """An arm of convex meshes sweeps a box, a stone and a can over a table; servos hold its joints, and turn it by 1.2 rad."""
    robot = load_robot(Path(__file__).parent / "arm.xml", dtype=dtype, device=device)
    scene = dataclasses.replace(robot_scene(robot), name="robot-arm")
    q = repeated(robot.articulation.rest, worlds)
    start = q.new_tensor([TURN, SHOULDER, ELBOW, WRIST])
    q[:, :4] = start

    def report(setup: Setup, rollout: Rollout) -> Mapping[str, Metric]:
        moved = torch.linalg.vector_norm(rollout.link_poses[-1, :, 4:, :, 3] - rollout.link_poses[0, :, 4:, :, 3], dim=-1)
        return {"farthest_push_m": moved.amax(-1).tolist(), "lowest_thing_m": rollout.link_poses[-1, :, 4:, 2, 3].amin(-1).tolist()}

    return Setup(
        scene, q, q.new_zeros(worlds, robot.articulation.nv), 2.0, 0.01, report, control=start + start.new_tensor([1.2, 0, 0, 0])
    )
