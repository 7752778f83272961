"""Differentiable, modular simulation of articulated bodies with frictional contact, stable at large time steps."""

from pbfd_torch.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.errors import InputError, ModelError, NotModelledWarning, PbfdError
from pbfd_torch.integrators.implicit_euler import ImplicitEuler, State
from pbfd_torch.rollout import Rollout
from pbfd_torch.simulator import Scene, Simulator
from pbfd_torch.solvers.continuation import Continuation
from pbfd_torch.solvers.jtj_lm import JtjLm
from pbfd_torch.solvers.objective import Solution, Status

__all__ = [
    "Articulation",
    "Continuation",
    "ImplicitEuler",
    "InputError",
    "Joint",
    "JointKind",
    "JtjLm",
    "Link",
    "ModelError",
    "NotModelledWarning",
    "PbfdError",
    "Rollout",
    "Scene",
    "Simulator",
    "Solution",
    "State",
    "Status",
]
