"""The equations of motion as functions: mass matrix, inverse dynamics, forward dynamics, energy and momentum, and how far
motions are apart."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pbfd_torch.balance.assembly import Balance
from pbfd_torch.terms.inertia import inertia_stiffness
from pbfd_torch.terms.joint_springs import Armature
from pbfd_torch.terms.load import LinkLoad, Term
from pbfd_torch.tree.articulation import Articulation
from pbfd_torch.tree.kinematics import Motion, Placement, link_residual, place, subtree_sum
from pbfd_torch.tree.rotations import unskew


def armature_diagonal(articulation: Articulation, terms: Sequence[Term]) -> Tensor:
    """Sum of the armatures among the terms, `[*, nv]`."""
    total = torch.zeros(articulation.nv, dtype=articulation.dtype, device=articulation.device)
    for term in terms:
        if isinstance(term, Armature):
            total = total + term.inertia
    return total


def mass_matrix(articulation: Articulation, q: Tensor, terms: Sequence[Term] = ()) -> Tensor:
    """Joint-space mass matrix M(q) `[*batch, nv, nv]`; `terms` may hold armatures, which add to its diagonal."""
    return mass_matrix_at(place(articulation, q), terms)


def mass_matrix_at(placement: Placement, terms: Sequence[Term] = ()) -> Tensor:
    """The same of an articulation that is placed already."""
    articulation = placement.articulation
    second = placement.poses @ articulation.pseudo_inertia @ placement.poses.mT
    still = torch.zeros_like(second[..., :3, :])
    inertia = Balance(placement, [LinkLoad(still, lambda: inertia_stiffness(second))]).stiffness
    return inertia + torch.diag_embed(armature_diagonal(articulation, terms))


def bias_force(articulation: Articulation, q: Tensor, v: Tensor, gravity: Tensor) -> Tensor:
    """Coriolis, centrifugal and gravity forces h(q, v) `[*batch, nv]` in M v̇ + h = τ; gravity `[*, 3]` [m/s²]."""
    placement = place(articulation, q)
    drift = Motion(placement, v).accelerations
    fall = torch.zeros_like(drift)
    fall[..., 3] = gravity[..., None, :]
    return generalised_momentum(placement, drift - fall)


def inverse_dynamics(
    articulation: Articulation, q: Tensor, v: Tensor, acceleration: Tensor, gravity: Tensor, terms: Sequence[Term] = ()
) -> Tensor:
    """Generalised force τ = M(q) v̇ + h(q, v) `[*batch, nv]` for acceleration v̇ `[*batch, nv]`."""
    inertia = (mass_matrix(articulation, q, terms) @ acceleration[..., None]).squeeze(-1)
    return inertia + bias_force(articulation, q, v, gravity)


def generalised_momentum(placement: Placement, rates: Tensor) -> Tensor:
    """⟨S Ṫ, ∂T/∂θ⟩ `[*batch, nv]` of links whose poses change at `rates` Ṫ `[*batch, nlink, 3, 4]`: M v where Ṫ = Σ ŝ_i T v_i."""
    moment = rates @ (placement.poses @ placement.articulation.pseudo_inertia).mT
    return link_residual(placement, subtree_sum(placement, moment), placement.axes)


def center_of_mass(placement: Placement) -> Tensor:
    """Centre of mass of the whole articulation [m] `[*batch, 3]`."""
    first = (placement.poses @ placement.articulation.pseudo_inertia)[..., :3, 3].sum(-2)
    return first / placement.articulation.mass.sum(-1, keepdim=True)


def momentum(placement: Placement, rates: Tensor) -> tuple[Tensor, Tensor]:
    """Linear momentum [kg m/s] and angular momentum about the centre of mass [kg m²/s], each `[*batch, 3]`, for link poses
    that change at `rates` Ṫ `[*batch, nlink, 3, 4]`: the integrals of ρ ṗ and ρ p × ṗ over the bodies."""
    first = (rates @ (placement.poses @ placement.articulation.pseudo_inertia).mT).sum(-3)
    linear = first[..., 3]
    return linear, unskew(first[..., :3]) - torch.linalg.cross(center_of_mass(placement), linear)


def kinetic_energy(articulation: Articulation, rates: Tensor) -> Tensor:
    """∫ρ ṗ²/2 over all links [J] `[*batch]`, for link poses that change at `rates` Ṫ `[*batch, nlink, 3, 4]`."""
    return 0.5 * ((rates @ articulation.pseudo_inertia) * rates).sum((-3, -2, -1))


def rotor_energy(articulation: Articulation, v: Tensor, terms: Sequence[Term]) -> Tensor:
    """Kinetic energy of the armatures among the terms [J] `[*batch]`."""
    return 0.5 * (armature_diagonal(articulation, terms) * v * v).sum(-1)


def potential_energy(placement: Placement, gravity: Tensor) -> Tensor:
    """−m g · x of the centre of mass [J] `[*batch]`: zero at the world's origin."""
    mass = placement.articulation.mass.sum(-1)
    return -mass * (gravity * center_of_mass(placement)).sum(-1)


def apart(articulation: Articulation, first: Tensor, second: Tensor) -> Tensor:
    """How far two configurations are apart [m] `[*batch]`: √(tr(D S Dᵀ)/m), D the difference of a body's poses, of the body for
    which it is the largest. Links that are fixed to each other are one body; those without mass do not count."""
    t = articulation.topology
    moved = (place(articulation, first).poses - place(articulation, second).poses)[..., :3, :]
    square = ((moved @ articulation.pseudo_inertia) * moved).sum((-2, -1))
    body = t.link_node_index
    square, mass = (x.new_zeros(*x.shape[:-1], t.njoint + 1).index_add(-1, body, x) for x in (square, articulation.mass))
    heavy = mass > 0
    return torch.where(heavy, square / torch.where(heavy, mass, torch.ones_like(mass)), 0.0).amax(-1).clamp_min(0).sqrt()
