"""Our robot files and the named scenes, one function per scene. Imports `loading`, `records` for a scene's metrics, and what lies
below; it makes no steps."""

from collections.abc import Callable

from pbfd_torch.models.boxes import box_slide, box_slope
from pbfd_torch.models.chains import chain_fixed, chain_free, chain_ground, chain_heavy, chain_slope, chain_slope_drop
from pbfd_torch.models.grounds import conveyor, mesh_terrain, ramp_grid, turntable
from pbfd_torch.models.manipulation import gripper, robot_arm
from pbfd_torch.models.robots import file_setup, hopper, quadruped, robot_setup, walker
from pbfd_torch.models.setup import Setup
from pbfd_torch.models.spinning import dzhanibekov
from pbfd_torch.models.stacks import arch, heavy_on_light, stack, stack_10

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
    "stack-10": stack_10,
    "heavy-on-light": heavy_on_light,
    "arch": arch,
    "turntable": turntable,
    "conveyor": conveyor,
    "ramp-grid": ramp_grid,
    "mesh-terrain": mesh_terrain,
    "gripper": gripper,
    "robot-arm": robot_arm,
    "hopper": hopper,
    "walker": walker,
    "quadruped": quadruped,
}

__all__ = ["SCENES", "Setup", "file_setup", "robot_setup"]
