"""What a named scene starts with: poses, contacts and their friction."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.models import Setup
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.tree.kinematics import Placement, place


def contact_of(setup: Setup) -> Contact:
    """The scene's one contact term."""
    (contact,) = [term for term in setup.scene.terms if isinstance(term, Contact)]
    return contact


def start(setup: Setup) -> Placement:
    return place(setup.scene.articulation, setup.q)


def depth(setup: Setup) -> Tensor:
    """Penetration depth of every candidate at the start `[worlds, npoint]`."""
    contacts = [term for term in setup.scene.terms if isinstance(term, Contact)]
    return torch.cat([term.depth(start(setup)) for term in contacts], -1)


def mu(setup: Setup) -> list[float]:
    """The friction coefficients of a scene's contact, one after the other."""
    contact = contact_of(setup)
    assert isinstance(contact.friction, CoulombFriction)
    own = torch.as_tensor(contact.friction.mu, dtype=torch.float64)
    found: list[float] = (own if contact.grip is None else own * contact.grip).flatten().tolist()
    return found
