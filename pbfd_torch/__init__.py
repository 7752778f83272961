"""Differentiable, modular simulation of articulated bodies with frictional contact, stable at large time steps."""

from pbfd_torch.errors import GradientError, GradientWarning, InputError, ModelError, NotModelledWarning, PbfdError
from pbfd_torch.gradients.contact_jacobians import ContactJacobian, contact_jacobians
from pbfd_torch.gradients.implicit import Blur, Doubt, Doubtful, Gradients
from pbfd_torch.gradients.linearization import Chart, Linearization
from pbfd_torch.gradients.parameters import parameters, with_parameters
from pbfd_torch.gradients.trajectory import Trajectory
from pbfd_torch.integrators.bdf2 import Bdf2
from pbfd_torch.integrators.energy_momentum import EnergyMomentum
from pbfd_torch.integrators.implicit_euler import ImplicitEuler
from pbfd_torch.integrators.integrator import State
from pbfd_torch.integrators.runge_kutta import RungeKutta
from pbfd_torch.integrators.variational import Variational
from pbfd_torch.records.rollout import Rollout
from pbfd_torch.scene import Scene
from pbfd_torch.show import view
from pbfd_torch.simulator import AdaptiveSimulator, EventSimulator, Simulator
from pbfd_torch.solvers.descent import Descent
from pbfd_torch.solvers.fallbacks import Fallbacks
from pbfd_torch.solvers.objective import Solution, Status
from pbfd_torch.tree.articulation import Articulation, Joint, JointKind, Link

__all__ = [
    "AdaptiveSimulator",
    "Articulation",
    "Bdf2",
    "Blur",
    "Chart",
    "ContactJacobian",
    "Descent",
    "Doubt",
    "Doubtful",
    "EnergyMomentum",
    "EventSimulator",
    "Fallbacks",
    "GradientError",
    "GradientWarning",
    "Gradients",
    "ImplicitEuler",
    "InputError",
    "Joint",
    "JointKind",
    "Linearization",
    "Link",
    "ModelError",
    "NotModelledWarning",
    "PbfdError",
    "Rollout",
    "RungeKutta",
    "Scene",
    "Simulator",
    "Solution",
    "State",
    "Status",
    "Trajectory",
    "Variational",
    "contact_jacobians",
    "parameters",
    "view",
    "with_parameters",
]
