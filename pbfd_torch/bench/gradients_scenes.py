"""What `pbfd bench gradients` differentiates: a tossed cube and a box that slides to rest, for us and for MuJoCo, and what others
have reported of the same.

The toss is the published one of DiffMJX (Paulus et al., "Differentiable simulation of hard contacts with soft gradients for
learning and control", ICLR 2026; repository martius-lab/diffmjx, experiment 04): gravity 2 m/s², a cube of .1 m and .1 kg, turned
by 60° about x, its centre .2 m above the ground, thrown at −.1 m/s along y and −2 m/s along z, friction 1; asked for is the
derivative of where it is along y after 1 s by its start velocity along z. Body, start and friction are the same for all; the
contact is each simulator's own, and so is the motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.bench import mujoco_runs
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Box, Collider
from pbfd_torch.gradients.parameters import with_parameters
from pbfd_torch.models import SCENES, boxes
from pbfd_torch.models.stacks import solid_box
from pbfd_torch.scene import Scene
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.contact_terms import contact_terms
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.tree.articulation import Articulation

HALF, MASS, GRAVITY, FRICTION = 0.05, 0.1, 2.0, 1.0  # of the cube [m], [kg], of the toss [m/s²]
HEIGHT, ACROSS, DOWN, TURNED = 0.2, -0.1, -2.0, math.radians(60)  # its start: z [m], ẏ, ż [m/s], about x
RELEASE = 0.336  # [m/s]: as fast as the first edge leaves the ground in MuJoCo, with the contact of the published file
SLIDING_SPEED, SLIDING_FRICTION = 1.0, 0.3  # of the box

Start = tuple[Scene, Tensor, Tensor]  # what moves, q `[worlds, nq]`, v `[worlds, nv]`
PeerStart = tuple[Any, Tensor, Tensor]  # an `MjModel`, q `[nq]`, v `[nv]`


@dataclass(frozen=True)
class Reported:
    """What others have reported of a problem, not measured here. NaN: not reported.

    Attributes:
        name: of the simulator, its scheme and its step.
        gradient: by each input.
        forward_s, total_s: of the motion alone, and of motion and gradient together [s].
        ratio: time of the gradient by that of the motion.
    """

    name: str
    gradient: tuple[float, ...]
    forward_s: float = math.nan
    total_s: float = math.nan
    ratio: float = math.nan


@dataclass(frozen=True)
class Problem:
    """The derivative of one coordinate's change by a few inputs.

    Attributes:
        name, title: in the list of problems, and what is differentiated.
        inputs, units: their names, and the units of the derivatives.
        at: their values.
        duration: [s] simulated.
        coordinate: which of q is observed.
        exact: the derivatives; None: each simulator is measured against itself at fine steps.
        start: (inputs `[worlds, n]`) → our scene and start, which carry derivatives by them.
        peer: (inputs `[n]`, Δt [s], integrator) → MuJoCo's.
        peers: MuJoCo's integrators that are measured.
        reported: by others.
        reported_reference: what the reported derivatives should be.
        reported_note: where they come from.
    """

    name: str
    title: str
    inputs: tuple[str, ...]
    units: tuple[str, ...]
    at: tuple[float, ...]
    duration: float
    coordinate: int
    exact: tuple[float, ...] | None
    start: Callable[[Tensor], Start]
    peer: Callable[[Tensor, float, str], PeerStart]
    peers: tuple[str, ...]
    reported: Sequence[Reported]
    reported_reference: tuple[float, ...]
    reported_note: str

    def values(self, worlds: int = 1) -> Tensor:
        """The inputs `[worlds, n]`."""
        return torch.tensor([self.at], dtype=torch.float64).expand(worlds, -1).clone()


def _cube() -> Scene:
    """The cube over the ground, as firm as our rules make contacts, let go at `RELEASE`: with the .1 m/s of our default it lies
    after .85 s, and what derivative is left jumps with the edge that it came to rest on."""
    articulation = Articulation.from_links([solid_box("cube", (HALF, HALF, HALF), MASS)])
    colliders = [Collider("cube", "cube", Box((HALF, HALF, HALF)), friction=FRICTION)]
    ground = HalfSpace(friction=FRICTION)
    terms = [
        replaced(term, normal_force=replaced(term.normal_force, release=RELEASE)) if isinstance(term, Contact) else term
        for term in contact_terms(articulation, colliders, (ground,))
    ]
    gravity = torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64)
    return Scene(articulation, (Inertia(), *terms), gravity, colliders, (ground,), "cube-toss")


def _tossed(values: Tensor) -> Start:
    still = torch.tensor([[0.0, ACROSS, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    down = torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    return _cube(), _tossed_place().expand(len(values), -1).clone(), still + values * down


def _tossed_place() -> Tensor:
    return torch.tensor([[0.0, 0.0, HEIGHT, math.cos(TURNED / 2), math.sin(TURNED / 2), 0.0, 0.0]], dtype=torch.float64)


def toss_mjcf() -> str:
    """The toss for MuJoCo: contacts as in the published file, which has 4 iterations to 1e-8 instead."""
    density = MASS / (2 * HALF) ** 3
    return f"""<mujoco><option gravity="0 0 {-GRAVITY}" solver="Newton" iterations="100" tolerance="1e-12" cone="pyramidal">
      <flag refsafe="disable" eulerdamp="disable"/></option>
      <default><geom friction="{FRICTION} .005 .0001" solimp="0 .95 .001 .5 2" solref=".005 1"/></default>
      <worldbody><geom type="plane" size="20 20 .1"/><body><freejoint/>
      <geom type="box" size="{HALF} {HALF} {HALF}" density="{density}"/></body></worldbody></mujoco>"""


def _peer_tossed(values: Tensor, dt: float, integrator: str) -> PeerStart:
    model = mujoco_runs.model_of(toss_mjcf(), dt, integrator)
    _, q, v = _tossed(values[None])
    return model, q[0], v[0]


def _sliding(values: Tensor) -> Start:
    setup = SCENES["box-slide"](worlds=len(values))
    scene = with_parameters(setup.scene, {"terms.1.friction.mu": values[:, 1:]})
    return scene, setup.q, torch.cat((values[:, :1], setup.v[:, 1:]), -1)


def _peer_sliding(values: Tensor, dt: float, integrator: str) -> PeerStart:
    model = mujoco_runs.loaded("box-slide", dt, integrator)
    model.geom_friction[:, 0] = float(values[1])
    setup = SCENES["box-slide"](worlds=1)
    return model, setup.q[0], torch.cat((values[:1], setup.v[0, 1:]))


_TOSS_REPORTED = (
    Reported("MJX Euler, 10 ms", (4.336281,), 0.0579, 0.2555),
    Reported("MJX Euler, 1 ms", (3.240441,), 0.5446, 3.292),
    Reported("MJX Euler, .1 ms", (0.132459,), 5.142, 30.99),
    Reported("MJX RK4, 1 ms", (0.927959,), 1.999, 11.95),
    Reported("MJX RK4, .1 ms", (0.151789,), 19.09, 113.7),
    Reported("DiffMJX Bosh3, 1e-3", (0.240489,), 0.4923, 2.983),
    Reported("DiffMJX Bosh3, 1e-5", (0.169435,), 1.345, 9.203),
    Reported("DiffMJX Tsit5, 1e-5", (0.185378,), 1.277, 8.328),
    Reported("DiffMJX Tsit5, 1e-7", (0.174882,), 2.393, 16.50),
    Reported("DiffMJX Tsit5, 1e-10", (0.172387,), 7.654, 55.89),
)
_BOX_REPORTED = (
    Reported("MJX pyramidal, forward mode", (0.3265, -0.5406), ratio=4.5),
    Reported("Brax spring", (0.3400, -0.5463), ratio=5.8),
    Reported("MuJoCo, chain of finite differences", (0.3267, math.nan), ratio=22),
    Reported("Nimble", (0.370, math.nan), ratio=56),
    Reported("Newton XPBD, tape", (0.014, -0.018)),
    Reported("MJX elliptic; Brax generalized: NaN", (math.nan, math.nan)),
)
_STOPS = SLIDING_SPEED / SLIDING_FRICTION / boxes.GRAVITY  # [s], v/(μg)
_COULOMB = (_STOPS, -0.5 * SLIDING_SPEED * _STOPS / SLIDING_FRICTION)
_PROBLEMS = (
    Problem(
        name="toss",
        title="cube toss: d y(1 s) / d ż",
        inputs=("ż",),
        units=("s",),
        at=(DOWN,),
        duration=1.0,
        coordinate=1,
        exact=None,
        start=_tossed,
        peer=_peer_tossed,
        peers=("Euler", "RK4"),
        reported=_TOSS_REPORTED,
        reported_reference=(0.17267,),
        reported_note="but published by the authors of DiffMJX: on their machine, without the 31 to 112 s of compilation; their "
        "reference: Tsit5 at 1e-12, .1727 s; their differences of ±.01 m/s: .1715 s. Their fork smooths the detection of contacts, "
        "so its motion is not that of MuJoCo either",
    ),
    Problem(
        name="box",
        title="sliding box: d x(.5 s) / d v, d μ",
        inputs=("v", "μ"),
        units=("s", "m"),
        at=(SLIDING_SPEED, SLIDING_FRICTION),
        duration=0.5,
        coordinate=0,
        exact=_COULOMB,
        start=_sliding,
        peer=_peer_sliding,
        peers=("implicitfast", "discrete", "RK4"),
        reported=_BOX_REPORTED,
        reported_reference=_COULOMB,
        reported_note="but in an earlier run, at 10 ms; ratio: time of the gradient by that of the motion; the error is that of "
        "what was told",
    ),
)
PROBLEMS: Mapping[str, Problem] = {problem.name: problem for problem in _PROBLEMS}
