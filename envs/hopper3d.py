"""The hopper with a free base."""

from __future__ import annotations

from pbfd_torch.envs.upright import UprightEnv


class Hopper3dEnv(UprightEnv):
    """Five motors: hip sideways and forward, knee, ankle forward and sideways; a flat foot. See `UprightEnv`."""

    file = "hopper3d.xml"
    lowest = 0.7
