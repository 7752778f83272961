"""Trajectory optimisation: shooting by torch's optimisers or Gauss–Newton, and iLQR with control limits. Built on the simulator's
trajectories and linearisations; it shares its least squares with `identify`."""

from pbfd_torch.identify.levenberg_marquardt import Bounds, Stopping
from pbfd_torch.optimize.backward_pass import Policy
from pbfd_torch.optimize.costs import Cost, Weights, quadratic
from pbfd_torch.optimize.decision import Controls, Decision, Plan, StartVelocity
from pbfd_torch.optimize.ilqr import Improved, Motion, Search, ilqr
from pbfd_torch.optimize.limits import Limits
from pbfd_torch.optimize.shooting import Shooting, Shot

__all__ = [
    "Bounds",
    "Controls",
    "Cost",
    "Decision",
    "Improved",
    "Limits",
    "Motion",
    "Plan",
    "Policy",
    "Search",
    "Shooting",
    "Shot",
    "StartVelocity",
    "Stopping",
    "Weights",
    "ilqr",
    "quadratic",
]
