"""A rollout as one picture: the motion as a stroboscope sees it, energy, penetration and iterations."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from numpy.typing import NDArray

from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.files import write_figure
from pbfd_torch.models import Setup
from pbfd_torch.records.rollout import Rollout

Frame = NDArray[np.float64]


def draw(setup: Setup, rollout: Rollout, path: Path, strobe_s: float = 0.9) -> None:
    """Writes a PNG. Left: side view of world 0 during the first `strobe_s` seconds, gravity pointing down. Right: curves over
    time."""
    figure = plt.figure(figsize=(13, 7.5), dpi=130, layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.35, 1))
    _strobe(figure.add_subplot(grid[:, 0]), setup, rollout, strobe_s)
    _energy(figure.add_subplot(grid[0, 1]), rollout)
    time = rollout.time[1:].cpu().numpy()
    _band(figure.add_subplot(grid[1, 1]), time, 1e3 * rollout.penetration.cpu().numpy(), "deepest penetration [mm]", "tab:red")
    _band(figure.add_subplot(grid[2, 1]), time, rollout.iterations.cpu().numpy(), "iterations per step", "tab:purple")
    unsolved = int((~rollout.solved).sum())
    figure.suptitle(
        f"{rollout.scene_name}: {setup.worlds} worlds, Δt = {rollout.dt:g} s, {rollout.steps} steps, {unsolved} unsolved",
        fontsize=14,
    )
    write_figure(path, figure)
    plt.close(figure)


def _strobe(axes: Axes, setup: Setup, rollout: Rollout, strobe_s: float) -> None:
    turn = _upright(setup)
    last = min(rollout.steps, round(strobe_s / rollout.dt))
    every = max(1, round(last / 18))
    frames = range(0, last + 1, every)
    tone = Normalize(0, last * rollout.dt)
    colors = plt.get_cmap("viridis")
    seen = []
    for frame in frames:
        points = _outline(setup, rollout, frame) @ turn.T
        seen.append(points)
        color = colors(0.95 * tone(frame * rollout.dt))
        axes.plot(points[:, 0], points[:, 1], "-o", color=color, linewidth=3.5, markersize=4.5, solid_capstyle="round", zorder=3)
    span = np.concatenate(seen)
    low, high = span.min(0) - 0.12, span.max(0) + 0.12
    for obstacle in setup.scene.obstacles:
        if not isinstance(obstacle, HalfSpace):
            continue
        along = np.array([low[0] - 5, high[0] + 5])
        normal = turn @ np.array(obstacle.normal)
        surface = (obstacle.offset - normal[0] * along) / normal[1]
        axes.fill_between(along, surface, low[1] - 20, facecolor="0.92", edgecolor="0.3", linewidth=1.5)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("z [m]")
    axes.set_title(f"world 0, one picture every {every * rollout.dt:.3g} s")
    axes.figure.colorbar(ScalarMappable(tone, colors), ax=axes, label="time [s]", shrink=0.7, pad=0.02)


def _upright(setup: Setup) -> Frame:
    """`[2, 3]` world → (right, up), so that gravity points down in the picture."""
    gravity = setup.scene.gravity.cpu().numpy().reshape(-1, 3)[0]
    tilt = np.arctan2(gravity[0], -gravity[2]) if np.any(gravity) else 0.0
    return np.array([[np.cos(tilt), 0, np.sin(tilt)], [-np.sin(tilt), 0, np.cos(tilt)]])


def _outline(setup: Setup, rollout: Rollout, frame: int) -> Frame:
    """World points `[n, 3]` along world 0's links: their frames, and where their colliders sit."""
    poses = rollout.link_poses[frame, 0].cpu().numpy()
    points = []
    for k, name in enumerate(rollout.link_names):
        places = [np.array(c.position) for c in setup.scene.colliders if c.link == name]
        points += [poses[k, :, :3] @ place + poses[k, :, 3] for place in places] or [poses[k, :, 3]]
    return np.array(points)


def _energy(axes: Axes, rollout: Rollout) -> None:
    time = rollout.time.cpu().numpy()
    for values, label, color in (
        (rollout.kinetic_energy, "kinetic", "tab:orange"),
        (rollout.potential_energy, "potential", "tab:blue"),
        (rollout.energy, "total", "black"),
    ):
        axes.plot(time, values[:, 0].cpu().numpy(), label=label, color=color)
    axes.set_xlabel("time [s]")
    axes.set_title("energy of world 0 [J]")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)


def _band(axes: Axes, time: Frame, values: Frame, title: str, color: str) -> None:
    """Median of all worlds as a line, their range as a band."""
    low, high = values.min(1), values.max(1)
    alike = bool((low == high).all())
    axes.plot(time, np.median(values, 1), color=color, label="all worlds alike" if alike else "median of the worlds")
    if not alike:
        axes.fill_between(time, low, high, color=color, alpha=0.25, linewidth=0, label="range of the worlds")
    axes.set_xlabel("time [s]")
    axes.set_title(title)
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
