"""Reference motions that use no simulator: the hung-up chain and the tumbling body, by Runge–Kutta 4."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pbfd_torch.models import SCENES
from pbfd_torch.models.chains import GRAVITY, LENGTH, MASS, RADIUS

Array = NDArray[np.float64]
STEP = 1e-4  # [s]
LINKS = 10


def runge_kutta(rate: Callable[[Array], Array], start: Array, dt: float, steps: int, every: int) -> Array:
    """The classical scheme of fourth order for ẏ = rate(y): y after `every`, 2 `every`, … steps, `[steps // every, n]`."""
    y, found = start, []
    for k in range(1, steps + 1):
        a = rate(y)
        b = rate(y + 0.5 * dt * a)
        c = rate(y + 0.5 * dt * b)
        d = rate(y + dt * c)
        y = y + dt / 6 * (a + 2 * b + 2 * c + d)
        if k % every == 0:
            found.append(y)
    return np.stack(found)


def chain_rate(y: Array) -> Array:
    """ẏ of the hung-up chain, y = (φ, φ̇), φ `[10]` [rad] the links' angles to the horizontal, about +y: Lagrange's equations
    Σ_k B_jk (cos(φ_j − φ_k) φ̈_k + sin(φ_j − φ_k) φ̇_k²) + I φ̈_j = g m Σ_i A_ij cos φ_j with B = m AᵀA."""
    phi, speed = y[:LINKS], y[LINKS:]
    between = phi[:, None] - phi[None]
    matrix = _COUPLING * np.cos(between) + _MOMENT * np.eye(LINKS)
    force = GRAVITY * MASS * _LEVERS.sum(0) * np.cos(phi) - (_COUPLING * np.sin(between)) @ speed**2
    return np.concatenate((speed, np.linalg.solve(matrix, force)))


# A_ij: how far link j carries the centre of mass of link i along itself [m]
_LEVERS = LENGTH * (np.tri(LINKS) - 0.5 * np.eye(LINKS))
_COUPLING = MASS * _LEVERS.T @ _LEVERS
_MOMENT = MASS * (3 * RADIUS**2 + LENGTH**2) / 12


def chain_tips(times: int, dt: float = STEP) -> Tensor:
    """Where the tip of chain-fixed is after .1, .2, … s, `[times, 3]` [m]."""
    each = round(0.1 / dt)
    phi = runge_kutta(chain_rate, np.zeros(2 * LINKS), dt, each * times, each)[:, :LINKS]
    x, z = LENGTH * np.cos(phi).sum(1), -LENGTH * np.sin(phi).sum(1)
    return torch.from_numpy(np.stack((x, np.zeros_like(x), z), 1))


def body_rate(y: Array, moments: Array) -> Array:
    """ẏ of a free rigid body, y = (quaternion wxyz, ω in the body's principal axes): q̇ = ½ q (0, ω), I ω̇ = Iω × ω."""
    (w, x, y_, z), (a, b, c) = y[:4], y[4:]
    turn = 0.5 * np.array((-x * a - y_ * b - z * c, w * a + y_ * c - z * b, w * b + z * a - x * c, w * c + x * b - y_ * a))
    i, j, k = moments
    return np.concatenate((turn, ((j - k) * b * c / i, (k - i) * c * a / j, (i - j) * a * b / k)))


def middle_axes(times: int, dt: float = STEP) -> Tensor:
    """Where the middle axis of dzhanibekov's body points after .1, .2, … s, `[times, 3]`."""
    setup = SCENES["dzhanibekov"]()
    second = setup.scene.articulation.pseudo_inertia[0, :3, :3].diagonal()
    moments = (second.sum() - second).numpy()
    start = np.concatenate((setup.q[0, 3:7].numpy(), setup.v[0, 3:].numpy()))
    each = round(0.1 / dt)
    path = runge_kutta(lambda y: body_rate(y, moments), start, dt, each * times, each)
    w, x, y, z = (path[:, :4] / np.linalg.norm(path[:, :4], axis=1, keepdims=True)).T
    return torch.from_numpy(np.stack((2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)), 1))
