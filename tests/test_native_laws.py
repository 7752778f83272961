"""Laws of contact other than the usual one in the compiled core: the reference's forces and derivatives, steps and records."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch

from pbfd_torch import Scene, Simulator
from pbfd_torch.cli.options import Friction, with_friction
from pbfd_torch.contact.shapes import Ellipsoid, Shape
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import Integrator
from pbfd_torch.models import SCENES
from pbfd_torch.native.engine import Native
from pbfd_torch.native.library import library
from pbfd_torch.native.stepper import NativeStepper
from pbfd_torch.solvers.objective import Status
from pbfd_torch.tensors.worlds import Worlds
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.contact_laws import ContactLaws
from pbfd_torch.terms.curved_contact import CurvedContact
from pbfd_torch.terms.friction_law import FrictionLaw
from pbfd_torch.terms.pbd_friction import PbdFriction
from pbfd_torch.terms.pbfd_friction import PbfdFriction
from pbfd_torch.terms.restitution import Restitution
from pbfd_torch.terms.static_friction import StaticFriction
from pbfd_torch.tree.kinematics import place, retract
from tests.native_parity import DT, compared, require_balance, require_single_precision, require_starts, require_steps, resting
from tests.native_piles import SHAPES, pile, thrown_together
from tests.test_native_contact import BALLS, GROUND, SOLIDS, WALL, beside, touching
from tests.test_native_records import recorded, require_same

pytestmark = pytest.mark.skipif(library() is None, reason="there is no compiled core")

STATIC = StaticFriction(0.9, 0.5)
LAWS: dict[str, FrictionLaw | None] = {
    "none": None,
    "static": STATIC,
    "printed": PbfdFriction.as_printed(3e7),
    "derived": PbfdFriction.as_derived(3e5),
    "broken exponents": PbfdFriction(1e7, 0.7, 1.3, 0.7),
    "whole gradient": PbdFriction(3e5),
    "steep gradient": PbdFriction(3e7, 1.5, 1.4),
}
GEOMETRIES: dict[str, tuple[tuple[Shape, ...], tuple[Any, ...], Any]] = {
    "half-spaces": (BALLS, (GROUND, WALL), Contact),
    "box": (BALLS, (SOLIDS["box"], GROUND), Contact),
    "terrain": (BALLS, (SOLIDS["terrain"],), Contact),
    "ellipsoid": ((Ellipsoid((0.08, 0.05, 0.03)),), (GROUND, WALL), CurvedContact),
    "ellipsoid on terrain": ((Ellipsoid((0.08, 0.05, 0.03)),), (SOLIDS["terrain"],), CurvedContact),
}
SCHEMES: tuple[Integrator[Any], ...] = (EnergyMomentum(), ImplicitEuler())


def with_laws(scene: Scene, change: Callable[[Any], Any]) -> Scene:
    """The scene with other laws in all its contacts."""
    terms = [change(term) if isinstance(term, ContactLaws) else term for term in scene.terms]
    return dataclasses.replace(scene, terms=tuple(terms))


def under(law: FrictionLaw | None) -> Callable[[Any], Any]:
    """Another friction."""
    return lambda term: dataclasses.replace(term, friction=law)


def require_fallbacks_alike(scene: Scene, q: torch.Tensor, v: torch.Tensor, steps: int = 4, fewer: float = 0.15) -> None:
    """By both schemes, from the same states: roots where both solve directly, hazards, and no more that fall back,
    nor much fewer."""
    for scheme in SCHEMES:
        simulator = Simulator(scene, DT, scheme)
        native = NativeStepper(simulator.eager)
        pairs = compared(native, native.initial_state(q, v, None), None, steps)
        pairs.require_roots()
        pairs.require_same()
        assert torch.equal(pairs.after.hazards[pairs.alike], pairs.expected.hazards[pairs.alike])
        plain = [int((x.status == int(Status.SOLVED)).sum()) for x in (pairs.solution, pairs.found)]
        assert -0.05 <= (plain[0] - plain[1]) / (steps * len(q)) <= fewer


def require_records(scene: Scene, q: torch.Tensor, v: torch.Tensor, steps: int = 6) -> None:
    """Of the same states by both schemes."""
    for scheme in SCHEMES:
        simulator = Simulator(scene, DT, scheme, engine=Native())
        require_same(*recorded(simulator, simulator.initial_state(q, v), None, steps))


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("law", LAWS)
def test_friction_with_the_world(law: str, geometry: str) -> None:
    scene = with_laws(touching(*GEOMETRIES[geometry]), under(LAWS[law]))
    state, q = beside(scene, 90)
    assert int((Simulator(scene, DT).eager.objective(state).push(q) > 0).sum()) > 20
    require_balance(scene, state, q)


@pytest.mark.parametrize("geometry", ["half-spaces", "ellipsoid"])
@pytest.mark.parametrize("law", [law for law in LAWS if law != "broken exponents"])
def test_steps_with_the_world(law: str, geometry: str) -> None:
    scene = with_laws(touching(*GEOMETRIES[geometry]), under(LAWS[law]))
    state, _ = beside(scene, 24, 5)
    require_steps(scene, state)
    require_starts(scene, state.q, state.v)
    require_fallbacks_alike(scene, state.q, state.v)
    require_records(scene, state.q, state.v)


@pytest.mark.parametrize("shapes", SHAPES)
@pytest.mark.parametrize("law", LAWS)
def test_friction_between_bodies(law: str, shapes: str) -> None:
    scene = pile(SHAPES[shapes], LAWS[law])
    if LAWS[law] is None:  # for which `pile` has the usual one
        scene = with_laws(scene, under(None))
    q, v = thrown_together(scene, 40)
    state = resting(q, v)
    assert int((Simulator(scene, DT).eager.objective(state).push(q) > 0).sum()) > 20
    require_balance(scene, state, q)
    require_balance(scene, state, retract(scene.articulation, q, DT * v))


@pytest.mark.parametrize("law", ["static", "derived", "whole gradient"])
def test_steps_between_bodies(law: str) -> None:
    scene = pile(SHAPES["balls on boxes"], LAWS[law])
    q, v = thrown_together(scene, 16, 3)
    require_steps(scene, resting(q[:8], v[:8]), steps=2)
    require_records(scene, q, v)


@pytest.mark.parametrize("exponent", [1.5, 2.5, 3.0])
def test_other_exponents(exponent: float) -> None:
    """Of the normal force, with the world and between bodies; what rides on the world stores energy too."""

    def harder(term: Any) -> Any:
        firm = 0.01 ** (2.0 - exponent)
        law = dataclasses.replace(term.normal_force, stiffness=firm * term.normal_force.stiffness, exponent=exponent)
        return dataclasses.replace(term, normal_force=law)

    scene = with_laws(touching(*GEOMETRIES["ellipsoid on terrain"]), harder)
    require_balance(scene, *beside(scene, 90))
    scene = with_laws(touching(*GEOMETRIES["box"]), harder)
    state, q = beside(scene, 24)
    require_balance(scene, state, q)
    require_steps(scene, state)
    require_records(scene, state.q, state.v)
    for shapes in ("boxes", "round"):
        scene = with_laws(pile(SHAPES[shapes]), harder)
        q, v = thrown_together(scene, 40)
        require_balance(scene, resting(q, v), retract(scene.articulation, q, DT * v))


def throwing(term: Any) -> Any:
    """Contacts that throw back, with other friction and another exponent among them."""
    friction, law = term.friction, term.normal_force
    if isinstance(term, Contact) and term.pairs[0][1] == "wall":
        friction, law = STATIC, dataclasses.replace(law, stiffness=0.1 * law.stiffness, exponent=1.5)
    return dataclasses.replace(term, friction=friction, normal_force=law, restitution=Restitution(0.7, 0.05))


def bounces(scene: Scene, state: Any, scheme: Integrator[Any] | None = None) -> int:
    """How many worlds bounce in the step from a state."""
    prepared = Simulator(scene, DT, scheme).eager.objective(state).prepared
    found = torch.stack([(x.bounce > 0).any(-1) for x in prepared if getattr(x, "bounce", None) is not None])
    return int(found.any(0).sum())


def lifted(scene: Scene, worlds: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Bodies that are about to touch: up to a centimetre above the solids, and coming."""
    state, _ = beside(scene, worlds, speed=1.0)
    q = state.q.clone()
    contact = next(term for term in scene.terms if isinstance(term, Contact))
    found = contact.points(
        contact.prepare(Simulator(scene, DT).eager.objective(resting(q, state.v)).step), place(scene.articulation, q)
    )
    deepest = found.depth.argmax(-1)[:, None]
    normal = found.normal.expand(*found.depth.shape, 3).take_along_dim(deepest[..., None], -2)[:, 0]
    gap = 0.01 * torch.linspace(0.02, 1.0, worlds, dtype=q.dtype)[:, None]
    q[:, :3] += (found.depth.take_along_dim(deepest, -1) + gap) * normal
    v = 0.2 * state.v
    v[:, :3] -= 1.5 * normal
    return q, v


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_restitution_with_the_world(geometry: str) -> None:
    scene = with_laws(touching(*GEOMETRIES[geometry]), throwing)
    q, v = lifted(scene, 60)
    state = resting(q, v)
    assert bounces(scene, state) > 5
    for share in (0.3, 1.0, 1.2):
        require_balance(scene, state, retract(scene.articulation, q, share * DT * v))
    if geometry in ("half-spaces", "box"):
        require_steps(scene, resting(q[:24], v[:24]))
        require_starts(scene, q[:24], v[:24])
        require_fallbacks_alike(scene, q[:24], v[:24], 1, 0.5)  # the reference searches for long where it gets hard at once
        require_records(scene, q[:24], v[:24])


@pytest.mark.parametrize("shapes", SHAPES)
def test_restitution_between_bodies(shapes: str) -> None:
    scene = with_laws(pile(SHAPES[shapes]), throwing)
    q, v = thrown_together(scene, 40)
    state = resting(q, 4.0 * v)
    assert bounces(scene, state) > 5
    require_balance(scene, state, retract(scene.articulation, q, DT * v))
    require_balance(scene, state, retract(scene.articulation, q, 4.0 * DT * v))
    if shapes == "balls on boxes":
        require_steps(scene, resting(q[:4], 4.0 * v[:4]), steps=1)
        require_records(scene, q[:16], 4.0 * v[:16], 3)


@pytest.mark.parametrize("law", ["static", "broken exponents", "steep gradient"])
@pytest.mark.parametrize("between", [False, True])
def test_no_world_knows_another(law: str, between: bool) -> None:
    """In batches of any size, in any lane; those whose numbers differ too."""
    scene = pile(SHAPES["balls on boxes"], LAWS[law]) if between else with_laws(touching(*GEOMETRIES["box"]), under(LAWS[law]))
    if between:
        q, v = thrown_together(scene, 19)
    else:
        state, _ = beside(scene, 19)
        q, v = state.q, state.v
    many = torch.linspace(0.5, 1.5, len(q), dtype=q.dtype)[:, None]

    def varied(term: Any) -> Any:
        friction = term.friction
        if isinstance(friction, StaticFriction):
            return dataclasses.replace(term, friction=StaticFriction(0.9 * many, 0.5 * many))
        return dataclasses.replace(term, friction=dataclasses.replace(friction, stiffness=friction.stiffness * many))

    for some in (scene, with_laws(scene, varied)):
        native = NativeStepper(Simulator(some, DT).eager)
        state = native.initial_state(q, v, None)
        states, _ = native.run(state, None, 6)
        for index in ([3], [18, 0, 3], [7, 8, 9, 10, 11, 12, 13, 14, 15]):
            part = Worlds((len(q),), torch.tensor(index))
            alone, _ = native.take(part).run(state.take(part), None, 6)
            assert torch.equal(alone.q, states.q[:, index])
            assert torch.equal(alone.v, states.v[:, index])
    require_balance(some, resting(q, v), retract(some.articulation, q, DT * v))


def test_single_precision() -> None:
    """Steps with all laws go on as those in double precision do."""
    for law in LAWS.values():

        def scene(dtype: torch.dtype, law: Any = law) -> Scene:
            return with_laws(touching(*GEOMETRIES["half-spaces"], dtype=dtype), under(law))

        require_single_precision(scene, lambda made: beside(made, 12, 5)[0])


@pytest.mark.parametrize("choice", Friction)
def test_choices_of_the_command(choice: Friction) -> None:
    """Scenes that are native with Coulomb's friction are so with any."""
    for name in SCENES:
        setup = SCENES[name]()
        touches = any(isinstance(term, ContactLaws) for term in setup.scene.terms)
        if not touches or not native_of(setup.scene):
            continue
        assert native_of(with_friction(setup, choice, DT).scene), name


def native_of(scene: Scene) -> bool:
    """Whether the core makes its steps."""
    return Simulator(scene, DT).engine == "native"
