"""Dense output: where bodies are between the recorded instants of a motion, by the cubic through both ends of a step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.checked import Array, as_tensor
from pbfd_torch.errors import InputError
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import coordinate_rates, place, velocity_of_rates


@dataclass(frozen=True, eq=False)
class DenseOutput:
    """A motion at `T` times, in SI units.

    Attributes:
        time: `[T]` [s].
        q: `[T, *batch, nq]` the configurations, with unit quaternions. v: `[T, *batch, nv]` the velocities.
        link_poses: `[T, *batch, nlink, 3, 4]` [R | t].
    """

    time: Tensor
    q: Tensor
    v: Tensor
    link_poses: Tensor


def dense_output(articulation: Articulation, time: Tensor, q: Tensor, v: Tensor, times: Array) -> DenseOutput:
    """A motion that is known at `time` `[n ≥ 2]` [s], rising, as q `[n, *batch, nq]` and v `[n, *batch, nv]`, at other times
    `[T]` [s] from its first to its last. Between two instants the coordinates, quaternions as four numbers that are scaled in the
    end, follow the cubic that has their places and rates at both: q is right to the fourth order of the distance, v to the third,
    where nothing strikes in between, and at the instants themselves both are those given, to the bit. Raises `InputError` for times
    outside, and for what is no list of them."""
    wanted = as_tensor("times", times, time.dtype, time.device)
    if wanted.ndim != 1:
        raise InputError(f"times has shape {tuple(wanted.shape)}: must be [T]")
    first, last = float(time[0]), float(time[-1])
    outside = ~((wanted >= time[0]) & (wanted <= time[-1]))
    if bool(outside.any()):
        raise InputError(f"times holds {float(wanted[outside][0]):.9g} s: must be from {first:.9g} to {last:.9g} s")
    index = (torch.searchsorted(time.contiguous(), wanted.contiguous(), right=True) - 1).clamp(0, len(time) - 2)
    one = (-1,) + (1,) * (q.ndim - 1)
    h = (time[index + 1] - time[index]).reshape(one)
    x = (wanted - time[index]).reshape(one) / h
    y = 1 - x
    ends = [(_near(articulation, q[k], q[index]), v[k]) for k in (index, index + 1)]
    (start, before), (end, after) = ends
    rates = [coordinate_rates(articulation, *pair) for pair in ends]
    way = end - start
    at = y * y * (1 + 2 * x) * start + x * x * (3 - 2 * x) * end + h * x * y * (y * rates[0] - x * rates[1])
    slope = 6 * x * y * way / h + y * (1 - 3 * x) * rates[0] + x * (1 - 3 * y) * rates[1]
    speed = velocity_of_rates(articulation, at, slope)
    at = articulation.topology.normalized(at)
    at = torch.where(x == 0, q[index], torch.where(x == 1, q[index + 1], at))
    speed = torch.where(x == 0, before, torch.where(x == 1, after, speed))
    return DenseOutput(wanted, at, speed, place(articulation, at).poses[..., :3, :])


def _near(articulation: Articulation, q: Tensor, other: Tensor) -> Tensor:
    """The same configuration with those of its quaternions, q or −q, that are near those of another one."""
    turning = articulation.topology.turning_q
    if len(turning) == 0:
        return q
    apart = (q[..., turning] * other[..., turning]).sum(-1, keepdim=True) < 0
    return q.index_copy(-1, turning.flatten(), torch.where(apart, -q[..., turning], q[..., turning]).flatten(-2))
