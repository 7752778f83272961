"""The walker with a free base."""

from __future__ import annotations

from pbfd_torch.envs.upright import UprightEnv


class Walker3dEnv(UprightEnv):
    """Ten motors: hips sideways and forward, knees, ankles forward and sideways; flat feet. See `UprightEnv`."""

    file = "walker3d.xml"
