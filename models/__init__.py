"""Our robot files and the named scenes, one function per scene."""

from collections.abc import Callable

from pbfd_torch.models.boxes import box_slide, box_slope, stack
from pbfd_torch.models.chains import chain_fixed, chain_free, chain_ground, chain_heavy, chain_slope, chain_slope_drop
from pbfd_torch.models.robots import file_setup, hopper, robot_setup, walker
from pbfd_torch.models.setup import Setup
from pbfd_torch.models.spinning import dzhanibekov

SCENES: dict[str, Callable[..., Setup]] = {
    "box-slide": box_slide,
    "box-slope": box_slope,
    "chain-fixed": chain_fixed,
    "chain-ground": chain_ground,
    "chain-slope": chain_slope,
    "chain-slope-drop": chain_slope_drop,
    "chain-heavy": chain_heavy,
    "chain-free": chain_free,
    "dzhanibekov": dzhanibekov,
    "stack": stack,
    "hopper": hopper,
    "walker": walker,
}

__all__ = ["SCENES", "Setup", "file_setup", "robot_setup"]
