"""What `pbfd bench speed` runs: of each scene a time step, what drives it and for how long, and the error of a motion beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.bench.precision_scenes import CASES, OWN, Case, swing, tenths
from pbfd_torch.bench.precision_tracks import Track
from pbfd_torch.bench.starts import scattered
from pbfd_torch.models import SCENES, Setup

CONTROL_STEP = 0.008  # [s] of the robots, as Gymnasium has it
SHIPPED = 4  # steps of Runge–Kutta 4 that Gymnasium's hopper and walker make in it
SCATTER, SCATTER_SPEED = 0.05, 0.2  # of the starts [rad], [rad/s, m/s]
NUDGE = 0.05  # of the starts of what rests [rad/s, m/s]


@dataclass(frozen=True, eq=False)
class Work:
    """What a contestant does in one call, in float64: q, v at the start `[worlds, nq]`, `[worlds, nv]`, and controls
    `[steps, worlds, nu]`, each held for a control step."""

    q: Tensor
    v: Tensor
    controls: Tensor

    @property
    def world_steps(self) -> int:
        """Control steps of single worlds."""
        return len(self.controls) * len(self.q)

    def of(self, first: int, worlds: int) -> Work:
        """The same of some worlds."""
        index = slice(first, first + worlds)
        return Work(self.q[index], self.v[index], self.controls[:, index])


def bent(setup: Setup) -> tuple[Tensor, Tensor]:
    """Starts q `[worlds, nq]`, v `[worlds, nv]` scattered around the scene's own in all hinges and slides, so that what is plane
    stays so."""
    topology = setup.scene.articulation.topology
    moved = torch.zeros(setup.scene.articulation.nv, dtype=torch.float64)
    moved[[start for start, size in zip(topology.v_start, topology.joint_sizes, strict=True) if size == (1, 1)]] = 1.0
    return scattered(setup, 0, SCATTER, SCATTER_SPEED, moved)


def tossed(setup: Setup) -> tuple[Tensor, Tensor]:
    """The same in all degrees of freedom, of bodies that fall."""
    return scattered(setup, 0, SCATTER, SCATTER_SPEED)


def nudged(setup: Setup) -> tuple[Tensor, Tensor]:
    """The scene's own configuration and small velocities, of bodies that touch each other from the start."""
    return scattered(setup, 0, 0.0, NUDGE)


@dataclass(frozen=True)
class Course:
    """One scene.

    Attributes:
        case: the motion that errors are read off, from the scene's own start.
        dt: control step, and ours [s].
        steps: control steps of a timed rollout.
        worlds: batches.
        drive: random controls are the held one ± this.
        alone: rollouts of a single world, one after another; one where nothing is random.
        shipped: least steps of MuJoCo's Runge–Kutta 4 in a control step.
        bound: error beyond which a motion of MuJoCo's is none of this scene [m].
        starts: of all worlds; the first one's is replaced by the scene's own.
    """

    case: Case
    dt: float
    steps: int
    worlds: tuple[int, ...] = (1, 64, 1024)
    drive: float = 0.0
    alone: int = 1
    shipped: int = 1
    bound: float = math.inf
    starts: Callable[[Setup], tuple[Tensor, Tensor]] = bent

    @property
    def scene(self) -> str:
        """Its name among `SCENES`."""
        return self.case.scene

    def setup(self, worlds: int, dtype: torch.dtype = torch.float64) -> Setup:
        """The scene."""
        return SCENES[self.scene](worlds=worlds, dtype=dtype)

    def work(self, worlds: int) -> Work:
        """Rollouts of that many worlds, the first from the scene's own start, others from starts near it; each under random
        controls of its own."""
        setup = self.setup(worlds)
        q, v = self.starts(setup)
        q[0], v[0] = setup.q[0], setup.v[0]
        held = setup.controls(self.steps)
        random = torch.Generator().manual_seed(1)
        drawn = 2 * torch.rand(held.shape, dtype=torch.float64, generator=random) - 1
        return Work(q, v, held + self.drive * drawn)


def first_link(track: Track) -> Tensor:
    """Where the first link is, every ten control steps until .4 s, `[5, worlds, 3]`."""
    times = 10 * CONTROL_STEP * torch.arange(1, 6, dtype=torch.float64)
    return track.poses[track.at(times), :, 0, :, 3]


def links_at_last(track: Track) -> Tensor:
    """Where the links are at .4 s, `[1, worlds, nlink, 3]`."""
    return track.poses[track.at(tenths(0.4, 0.4))][..., 3]


def arm_at_last(track: Track) -> Tensor:
    """The same of the arm's own four links: what it hits goes where no reference is converged."""
    return links_at_last(track)[..., :4, :]


def landed(track: Track) -> Tensor:
    """Centre of mass of all bodies at .36 s, `[1, worlds, 3]`."""
    return track.center[track.at(torch.tensor([0.36], dtype=torch.float64))]


def _around_stance(scene: str, count: int, size: float) -> Callable[[Tensor], Tensor]:
    """Sines about the control that holds the scene."""
    sines = swing(count, size)

    def control(time: Tensor) -> Tensor:
        held = SCENES[scene]().control
        return sines(time) if held is None else held + sines(time)

    return control


def _robot(scene: str, motors: int, drive: float) -> Course:
    title = f"{scene}: root, .4 s"
    control = _around_stance(scene, motors, 0.1)
    case = Case(scene, title, "m", 0.4, (), first_link, None, OWN, observed_s=0.4, control=control, frame=CONTROL_STEP)
    return Course(case, CONTROL_STEP, 125, drive=drive, alone=8, shipped=SHIPPED)


def _resting(scene: str) -> Callable[[], Tensor]:
    """`links_at_last` of free bodies that stay where they are."""
    return lambda: SCENES[scene]().q.reshape(1, 1, -1, 7)[..., :3]


def _touching(
    scene: str,
    dt: float,
    observe: Callable[[Track], Tensor],
    exact: Callable[[], Tensor] | None = None,
    motors: int = 0,
    drive: float = 0.0,
) -> Course:
    """Bodies that touch each other from the start or nearly so, controlled by so many motors."""
    control = _around_stance(scene, motors, 0.0) if motors else None
    case = Case(scene, f"{scene}: links, .4 s", "m", 0.4, (), observe, exact, OWN, control=control, frame=dt)
    return Course(case, dt, round(1 / dt), (1, 64), drive, starts=nudged)


_LANDING = Case("mesh-terrain", "mesh-terrain: centre of mass, .36 s", "m", 2.0, (), landed, None, OWN, observed_s=0.36)
_USUAL = (
    _robot("hopper", 3, 1.0),
    _robot("walker", 6, 1.0),
    _robot("quadruped", 12, 0.3),
    Course(CASES["chain-ground"], 0.02, 100, (1, 64, 256, 1024)),
    Course(CASES["chain-slope-drop"], 0.05, 100, bound=0.5),
    Course(_LANDING, 0.01, 200, (1, 64), starts=tossed),
)
_ASKED = (
    _touching("stack-10", 0.02, links_at_last, _resting("stack-10")),
    _touching("arch", 0.02, links_at_last, _resting("arch")),
    _touching("gripper", 0.02, links_at_last, motors=2, drive=1.0),
    _touching("robot-arm", 0.01, arm_at_last, motors=4, drive=0.1),
    _touching("turntable", 0.02, links_at_last),
)
COURSES: Mapping[str, Course] = {course.scene: course for course in (*_USUAL, *_ASKED)}
USUAL = tuple(course.scene for course in _USUAL)  # that are run where none are asked for
