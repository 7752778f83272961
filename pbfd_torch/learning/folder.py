"""The folder of a training: checkpoints, curve and picture, each written whole, and gone on with after an interruption.

Beside the last checkpoint there is the best: the one at which the mean return of the last 64 episodes was highest."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from pbfd_torch.errors import InputError
from pbfd_torch.files import whole_file
from pbfd_torch.learning import curve
from pbfd_torch.learning.checkpoint import FORMAT, load_checkpoint

PICTURE_EVERY = 30.0  # [s]
CHECKPOINT, BEST, CURVE, PICTURE = "checkpoint.pt", "best.pt", "curve.csv", "curve.png"


class Folder:
    """Holds the curve so far, whose picture has a `title`, and what was `saved` where a training is gone on with.

    Raises `InputError` where the folder holds a training and `resume` is not set, and for a checkpoint of another method."""

    def __init__(self, path: Path, method: str, title: str, resume: bool) -> None:
        self.path, self.method, self.title = path, method, title
        self.rows: list[curve.Row] = []
        self.seconds, self._drawn = 0.0, -math.inf
        self.saved: dict[str, Any] | None = None
        checkpoint = path / CHECKPOINT
        if checkpoint.exists():
            if not resume:
                raise InputError(f"'{path}' holds a training already: resume it, or choose another folder")
            self.saved = load_checkpoint(checkpoint)
            if self.saved["method"] != method:
                raise InputError(f"'{path}' holds a training by {self.saved['method']}: go on with that, or choose another folder")
            self.rows = curve.rows_of(self.saved["rows"])
            self.seconds = self.saved["seconds"]
            try:
                torch.set_rng_state(self.saved["random"])
            except RuntimeError as error:
                raise InputError(f"'{checkpoint}' is not a usable checkpoint: random is no state of torch's generator") from error
        path.mkdir(parents=True, exist_ok=True)

    @property
    def frames(self) -> int:
        """Environment steps so far."""
        return self.rows[-1].frames if self.rows else 0

    def fall(self, decay: int) -> float:
        """What is left of a learning rate: from 1, in a line, to a tenth after `decay` environment steps, and so on from there."""
        return max(0.1, 1 - 0.9 * self.frames / decay)

    def write(self, settings: Mapping[str, Any], parts: Mapping[str, Any]) -> None:
        """Everything there is to go on with. `settings` holds those of the environment under "env", and the networks' "width"."""
        content = {
            "format": FORMAT,
            "method": self.method,
            "settings": dict(settings),
            "rows": [asdict(row) for row in self.rows],
            "seconds": self.seconds,
            "random": torch.get_rng_state(),
            **parts,
        }
        means = [x for x in curve.trailing(self.rows) if not math.isnan(x)]
        best = means and means[-1] > max(means[:-1], default=-math.inf)
        for name in (BEST, CHECKPOINT) if best else (CHECKPOINT,):
            with whole_file(self.path / name) as file:
                torch.save(content, file)
        curve.save(self.rows, self.path / CURVE)
        if time.monotonic() - self._drawn > PICTURE_EVERY:
            self.draw()

    def draw(self) -> None:
        """The picture of the curve so far: takes longer than the rest, so `write` does it now and then only."""
        curve.draw({self.method: self.rows}, self.path / PICTURE, self.title)
        self._drawn = time.monotonic()
