"""Domain randomisation: every world draws its own masses, friction and gains when it is reset, and is pushed now and then."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.scene import Scene
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.actuators import Actuators
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
        low, high = torch.tensor([self.mass, self.friction, self.gain], dtype=torch.float64, device=random.device).unbind(-1)
        share = torch.rand(worlds, 3, generator=random, dtype=torch.float64, device=random.device)
        return {"world_factors": low + (high - low) * share, "world_push": torch.zeros_like(share)}

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

    def applied(self, scene: Scene, drawn: dict[str, Tensor]) -> Scene:
        """The scene of the worlds with what was drawn for them."""
        a = scene.articulation
        mass, friction, gain = drawn["world_factors"].to(a.dtype).unbind(-1)
        terms = [replaced(term, gear=term.gear * gain[:, None]) if isinstance(term, Actuators) else term for term in scene.terms]
        if self.push > 0:
            force = torch.zeros((len(mass), a.nlink, 3), dtype=a.dtype, device=a.device)
            force[:, 0] = drawn["world_push"].to(a.dtype)
            terms.append(Pushes.at_centers(a, force))
        scaled = replaced(a, pseudo_inertia=a.pseudo_inertia * mass[:, None, None, None])
        scene = replaced(scene, articulation=scaled, terms=tuple(terms))
        if self.friction == (1.0, 1.0):
            return scene
        mus = {name: value for name, value in parameters(scene).items() if name.endswith(".friction.mu")}
        return with_parameters(scene, {name: value * friction[:, None] for name, value in mus.items()})
