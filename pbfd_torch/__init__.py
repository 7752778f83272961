"""Differentiable, modular simulation of articulated bodies with frictional contact, stable at large time steps."""

from pbfd_torch.articulation import Articulation, Joint, JointKind, Link
from pbfd_torch.errors import InputError, ModelError, NotModelledWarning, PbfdError
from pbfd_torch.integrators.bdf2 import Bdf2
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import State
from pbfd_torch.integrators.variational import Variational
from pbfd_torch.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.simulator import Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.objective import Solution, Status

__all__ = [
    "Articulation",
    "Bdf2",
    "Descent",
    "EnergyMomentum",
    "Fallbacks",
    "ImplicitEuler",
    "InputError",
    "Joint",
    "JointKind",
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
    "Variational",
]
