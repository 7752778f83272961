"""Domain randomisation: every world draws its own masses, friction and gains when it is reset, and is pushed now and then."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.simulator import Simulator
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.actuators import Actuators
from pbfd_torch.terms.load import Term
from pbfd_torch.terms.pushes import Pushes

Range = tuple[float, float]


@dataclass(frozen=True)
class Randomization:
    """Factors are uniform in their ranges; a range of one number leaves that alone.

    Attributes:
        mass: of all masses and inertias of a world, > 0.
        friction: of all μ, ≥ 0.
        gain: of all actuators' gears, > 0.
        push: [N] strength of a horizontal push on the first link, in a random direction (along x where `planar`).
        push_probability: per control step that a push begins or ends, from 0 to 1.
        planar: for robots that move in the x–z plane.
    """

    mass: Range = (1.0, 1.0)
    friction: Range = (1.0, 1.0)
    gain: Range = (1.0, 1.0)
    push: float = 0.0
    push_probability: float = 0.0
    planar: bool = True

    def __post_init__(self) -> None:
        for name in ("mass", "friction", "gain"):
            low, high = getattr(self, name)
            if not (math.isfinite(high) and 0 <= low <= high and (low > 0 or name == "friction")):
                raise InputError(f"{name} range is ({low}, {high}): must rise, be finite and > 0 (friction: ≥ 0)")
        if not (math.isfinite(self.push) and self.push >= 0):
            raise InputError(f"push is {self.push} N: must be ≥ 0 and finite")
        if not 0 <= self.push_probability <= 1:
            raise InputError(f"push_probability is {self.push_probability}: must be from 0 to 1")

    @property
    def nothing(self) -> bool:
        """Whether all worlds are alike."""
        return self == Randomization(planar=self.planar)

    def drawn(self, worlds: int, random: torch.Generator) -> dict[str, Tensor]:
        """Factors of mass, friction and gain `[worlds, 3]`, and no push yet, `[worlds, 3]` [N]."""
        shares = torch.rand(worlds, 3, generator=random, dtype=torch.float64, device=random.device)
        ranges = (self.mass, self.friction, self.gain)
        factors = [low + (high - low) * share for (low, high), share in zip(ranges, shares.unbind(-1), strict=True)]
        return {"world_factors": torch.stack(factors, -1), "world_push": torch.zeros_like(shares)}

    def pushed(self, push: Tensor, random: torch.Generator) -> Tensor:
        """The pushes of the next control step: in some worlds one begins, or ends."""
        if self.push == 0 or self.push_probability == 0:
            return push
        chance, turn = torch.rand(2, len(push), generator=random, dtype=torch.float64, device=random.device)
        angle = math.pi * (turn > 0.5) if self.planar else 2 * math.pi * turn
        fresh = self.push * torch.stack((torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)), -1)
        if self.planar:
            fresh[:, 1] = 0
        begun = (push == 0).all(-1, keepdim=True)
        return torch.where((chance < self.push_probability)[:, None], torch.where(begun, fresh, torch.zeros_like(fresh)), push)


class DrawnWorlds:
    """The simulators of worlds that have drawn their numbers. What a device would have to be asked is asked once, here."""

    def __init__(self, simulator: Simulator[Any], randomization: Randomization) -> None:
        self._simulator, scene = simulator, simulator.scene
        self._friction = {}
        if randomization.friction != (1.0, 1.0):
            self._friction = {name: value for name, value in parameters(scene).items() if name.endswith(".friction.mu")}
        if randomization.push > 0:
            a = scene.articulation
            scene = replaced(scene, terms=(*scene.terms, Pushes.at_centers(a, a.rest.new_zeros(1, a.nlink, 3))))
        self._scene = scene

    def simulator(self, factors: Tensor, push: Tensor) -> Simulator[Any]:
        """Of worlds with these factors of mass, friction and gain `[worlds, 3]` and pushes `[worlds, 3]` [N]."""
        a = self._scene.articulation  # checked with the friction, while it is one for all worlds
        mass, friction, gain = factors.to(a.dtype).unbind(-1)
        links = torch.nn.functional.pad(push.to(a.dtype)[:, None], (0, 0, 0, a.nlink - 1))
        scene = with_parameters(self._scene, {name: value * friction[:, None] for name, value in self._friction.items()})
        terms: list[Term] = []
        for term in scene.terms:
            if isinstance(term, Actuators):
                terms.append(replaced(term, gear=term.gear * gain[:, None]))
            else:
                terms.append(replaced(term, force=links) if isinstance(term, Pushes) else term)
        scaled = replaced(a, pseudo_inertia=a.pseudo_inertia * mass[:, None, None, None])
        return self._simulator.with_scene(replaced(scene, articulation=scaled, terms=tuple(terms)))
