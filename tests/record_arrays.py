"""Which fields of a rollout are arrays, and which of these run over time."""

from __future__ import annotations

import dataclasses

from pbfd_torch import Rollout

ARRAYS = [f.name for f in dataclasses.fields(Rollout) if f.type == "Tensor"]
OVER_TIME = [name for name in ARRAYS if name not in ("lanes", "obstacle_poses")]  # the obstacles stand still
