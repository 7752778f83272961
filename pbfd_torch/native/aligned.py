"""Nodes turned by constants, so that what moves them is simple."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.tensors.plain import carries
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.tree.articulation import Articulation, homogeneous


def aligned(a: Articulation) -> Articulation:
    """The same tree with nodes turned by constants, so that hinges turn about the node's z, and slides move along it: by those of
    each world where the worlds' frames differ. Frames and axes that carry derivatives keep them."""
    t, eye = a.topology, torch.eye(3, dtype=a.dtype)[None]
    z = eye[..., 2]
    frames: list[Tensor] = []
    turns = [eye]  # of the world, and of each node, [*, 1, 3, 3]
    for j, (size, parent) in enumerate(zip(t.joint_sizes, t.joint_parent, strict=True)):
        frame = _turned(turns[parent].mT, a.joint_frame[..., j, None, :, :])
        turn = eye
        if size == (1, 1):
            rotation, axis = frame[..., :3, :3], a.joint_axis[..., j, None, :]
            there = (rotation[..., 2, :] - axis).abs().amax(-1) <= 4.0 * torch.finfo(a.dtype).eps
            as_parent = there[..., None, None] & (not (carries(rotation) or carries(axis)))  # which cannot tilt
            turn = torch.where(as_parent, rotation.mT, _turning(axis))
            frame = homogeneous(torch.where(as_parent, eye, rotation @ turn), frame[..., :3, 3])
        turns.append(turn)
        frames.append(frame)
    links = [_turned(turns[node].mT, a.link_frame[..., i, None, :, :]) for i, node in enumerate(t.link_node)]
    return replaced(a, joint_frame=side_by_side(frames), joint_axis=z.expand(t.njoint, 3), link_frame=side_by_side(links))


def side_by_side(each: list[Tensor]) -> Tensor:
    """Matrices `[*, 1, …]` of joints or links, some of them of each world, as `[*, n, …]`."""
    return torch.cat(torch.broadcast_tensors(*each), -3)


def _turned(rotation: Tensor, frame: Tensor) -> Tensor:
    return homogeneous(rotation @ frame[..., :3, :3], (rotation @ frame[..., :3, 3:]).squeeze(-1))


def _turning(axis: Tensor) -> Tensor:
    """Rotations `[*, 3, 3]` that take z to unit vectors `[*, 3]`; along x, y and z without rounding."""
    x = torch.linalg.cross(torch.eye(3, dtype=axis.dtype)[axis.abs().argmin(-1)], axis)
    x = x / torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    return torch.stack((x, torch.linalg.cross(axis, x), axis), dim=-1)
