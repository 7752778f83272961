"""System identification: physical parameters from measured motion. Built on the simulator's trajectories."""

from pbfd_torch.identify.case import Case
from pbfd_torch.identify.certainty import Certainty, certainty
from pbfd_torch.identify.columns import linearized
from pbfd_torch.identify.identification import Experiment, Identification, Identified, Prior
from pbfd_torch.identify.levenberg_marquardt import Bounds, Fit, Outcome, Stopping, levenberg_marquardt
from pbfd_torch.identify.measurements import Configurations, Markers, Measurement
from pbfd_torch.identify.unknowns import CenterOfMass, Mass, Parameter, Quantity, Spread, Start, Unknown

__all__ = [
    "Bounds",
    "Case",
    "CenterOfMass",
    "Certainty",
    "Configurations",
    "Experiment",
    "Fit",
    "Identification",
    "Identified",
    "Markers",
    "Mass",
    "Measurement",
    "Outcome",
    "Parameter",
    "Prior",
    "Quantity",
    "Spread",
    "Start",
    "Stopping",
    "Unknown",
    "certainty",
    "levenberg_marquardt",
    "linearized",
]
