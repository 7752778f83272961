"""Nodes turned by constants, so that what moves them is simple."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pbfd_torch.tree.articulation import Articulation


def aligned(a: Articulation) -> Articulation:
    """The same tree with nodes turned by constants, so that hinges turn about the node's z, and slides move along it."""
    t, eye = a.topology, torch.eye(3, dtype=a.dtype)
    z = eye[2]
    frames = a.joint_frame.clone()
    turns = [eye]  # of the world, and of each node
    for j, (size, parent) in enumerate(zip(t.joint_sizes, t.joint_parent, strict=True)):
        frame = _pose(turns[parent]).mT @ frames[j]
        as_parent = frame[:3, :3].mT
        frames[j] = frame
        if size != (1, 1):
            turns.append(eye)
        elif torch.allclose(as_parent @ z, a.joint_axis[j], rtol=0.0, atol=4.0 * torch.finfo(a.dtype).eps):
            turns.append(as_parent)
            frames[j, :3, :3] = eye
        else:
            turns.append(_turning(a.joint_axis[j]))
            frames[j, :3, :3] = frame[:3, :3] @ turns[-1]
    links = torch.stack([_pose(turns[node]).mT @ frame for node, frame in zip(t.link_node, a.link_frame, strict=True)])
    return replace(a, joint_frame=frames, joint_axis=z.expand(t.njoint, 3), link_frame=links)


def _pose(rotation: Tensor) -> Tensor:
    pose = torch.eye(4, dtype=rotation.dtype)
    pose[:3, :3] = rotation
    return pose


def _turning(axis: Tensor) -> Tensor:
    """A rotation that takes z to a unit vector; along x, y and z without rounding."""
    x = torch.linalg.cross(torch.eye(3, dtype=axis.dtype)[int(axis.abs().argmin())], axis)
    x = x / x.norm()
    return torch.stack((x, torch.linalg.cross(axis, x), axis), dim=-1)
