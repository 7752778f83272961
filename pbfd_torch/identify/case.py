"""What the runs of an experiment set out from, with numbers of the scene that a fit may change."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

from pbfd_torch.errors import InputError
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.scene import Scene


@dataclass(frozen=True, eq=False)
class Case:
    """A scene and the starts of several runs in it. Where many cases are simulated at once, `batch` says how many.

    Attributes:
        scene: the same for all runs, so its parameters have no dimensions for worlds.
        q: `[*batch, runs, nq]`; v: `[*batch, runs, nv]` at t = 0.
        batch: of cases.
        numbers: parameters of the scene that were replaced, by name, `[*batch, *event]`.
    """

    scene: Scene
    q: Tensor
    v: Tensor
    batch: tuple[int, ...] = ()
    numbers: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        a, rank = self.scene.articulation, len(self.batch) + 2
        if (self.q.ndim, self.v.ndim) != (rank, rank) or self.q.shape[-1] != a.nq or self.v.shape != (*self.q.shape[:-1], a.nv):
            shapes = f"{tuple(self.q.shape)} and {tuple(self.v.shape)}"
            raise InputError(f"q and v have shapes {shapes}: must be [runs, {a.nq}] and [runs, {a.nv}]")

    @property
    def runs(self) -> int:
        """How often the experiment was made."""
        return self.q.shape[-2]

    def repeated(self, *batch: int) -> Case:
        """This case as a batch of cases."""
        return dataclasses.replace(
            self,
            q=self.q.expand(*batch, *self.q.shape),
            v=self.v.expand(*batch, *self.v.shape),
            batch=(*batch, *self.batch),
            numbers={name: value.expand(*batch, *value.shape) for name, value in self.numbers.items()},
        )

    def number(self, name: str) -> Tensor:
        """A parameter of the scene `[*batch, *event]`. Raises `InputError` for a name that it does not have."""
        if name in self.numbers:
            return self.numbers[name]
        known = parameters(self.scene)
        if name not in known:
            raise InputError(f"no parameter named {name}: the names are {', '.join(known)}")
        return known[name].detach().expand((*self.batch, *known[name].shape))

    def with_number(self, name: str, value: Tensor) -> Case:
        """The same case with a parameter `[*batch, *event]` replaced."""
        return dataclasses.replace(self, numbers={**self.numbers, name: value})

    @property
    def world_scene(self) -> Scene:
        """The scene of all worlds `[*batch, runs]`."""
        rank = len(self.batch)
        # a number that acts on many joints or contacts has a dimension for them, of length 1
        rows = {k: x[..., None, None] if x.ndim == rank else x.unsqueeze(rank) for k, x in self.numbers.items()}
        return with_parameters(self.scene, rows) if rows else self.scene
