"""Hard cases of bodies that rest on each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from pbfd_torch.bench.hard_cases_case import TIME_STEPS, Case, Check, Run, most
from pbfd_torch.bench.hard_cases_scenes import GRAVITY, STIFFNESS, coulomb, down, row
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Sphere
from pbfd_torch.models.setup import Setup
from pbfd_torch.models.stacks import heavy_on_light as heavy_on_light_setup
from pbfd_torch.models.stacks import solid_box, stack, stack_10
from pbfd_torch.scene import Scene
from pbfd_torch.terms.contact_terms import ContactRules, contact_terms
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import Articulation

RADIUS = 0.1  # [m]


def sphere_stack(run: Run) -> Sequence[Check]:
    """A ball of 100 kg on one of 1 kg, upright by symmetry, from gaps of 1 mm: after 1.5 s the ground bears 101 g and the pair
    100 g, to 2 %."""
    articulation = Articulation.from_links([solid_box(f"ball{m:g}", (RADIUS,) * 3, m) for m in (1.0, 100.0)])
    colliders = [Collider(name, name, Sphere(RADIUS)) for name in ("ball1", "ball100")]
    terms = contact_terms(articulation, colliders, [HalfSpace()], ContactRules(NormalForce(STIFFNESS), coulomb(0.5)))
    q = row(0, 0, RADIUS + 1e-3, 1, 0, 0, 0, 0, 0, 3 * RADIUS + 2e-3, 1, 0, 0, 0)
    rollout = run.roll(Scene(articulation, (Inertia(), *terms), down(), colliders), 1.5, q)
    # the mean over the last tenth of a second: impulses, whatever trembles
    steps = max(1, round(0.1 / run.dt))
    force = rollout.contact_force[-steps:, :, 2].abs().mean(0)
    pair, ground = (float(x) for x in force.topk(2).values.sort().values)
    return (
        Check("ground force error", abs(ground / (101 * GRAVITY) - 1), 0.02),
        Check("pair force error", abs(pair / (100 * GRAVITY) - 1), 0.02),
        run.solved(),
    )


def heavy_on_light(run: Run) -> Sequence[Check]:
    """A cube of 1000 kg and 1 m at rest on one of 1 kg and .1 m, 10 s: neither moves by 1 mm."""
    return _still(run, heavy_on_light_setup, 10.0, 1.0)


def stack_of_5(run: Run) -> Sequence[Check]:
    """Five boxes on each other, 10 s: the top moves by less than 1 mm."""
    return _still(run, stack, 10.0, 1.0)


def stack_of_10(run: Run) -> Sequence[Check]:
    """Ten boxes on each other, 10 s: the top moves by less than 1 mm."""
    return _still(run, stack_10, 10.0, 1.0)


def _still(run: Run, make: Callable[[], Setup], full: float, brief: float) -> Sequence[Check]:
    setup = make()
    rollout = run.roll_setup(setup, run.seconds(full, brief))
    moved = most(torch.as_tensor(setup.metrics(rollout)["largest_move_m"]))
    return Check("motion [mm]", 1e3 * moved, 1.0), run.solved()


CASES = (
    Case(sphere_stack, TIME_STEPS[2:], (1 / 20,)),
    Case(heavy_on_light, (1 / 100, 1 / 20, 1 / 10), (1 / 20,)),
    Case(stack_of_5, (1 / 100, 1 / 20, 1 / 10), (1 / 20,)),
    Case(stack_of_10, (1 / 20, 1 / 10), (1 / 20,)),
)
