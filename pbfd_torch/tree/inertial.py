"""Mass, centre of mass and inertia as ten numbers that may take any value: the log-Cholesky parametrisation of Rucker & Wensing
(*Smooth Parameterization of Rigid-Body Inertia*, RA-L 2022).

The pseudo-inertia S (METHOD Eq. 5) of a body is positive definite exactly where some density has it: where the mass is positive and
the principal moments satisfy the triangle inequality. So S = U Uᵀ with

    U = e^α ⎡ e^d₁  s₁₂  s₁₃  t₁ ⎤
            ⎢  0   e^d₂  s₂₃  t₂ ⎥
            ⎢  0    0   e^d₃  t₃ ⎥
            ⎣  0    0    0    1  ⎦

and every (α, d₁, d₂, d₃, s₁₂, s₂₃, s₁₃, t₁, t₂, t₃) is a body, every body one of them. e^{2α} is the mass [kg], t the centre of
mass [m], and d and s the spread of the mass about it: they stay the same where only the mass or the centre of mass changes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.errors import InputError

SIZE = 10
NAMES = ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3")
LOG_MASS = slice(0, 1)  # α, half of the mass's logarithm
SPREAD = slice(1, 7)
COM = slice(7, 10)

_ROWS = (0, 1, 2, 0, 1, 0)  # of d and s in U
_COLUMNS = (0, 1, 2, 1, 2, 2)


def log_cholesky(pseudo_inertia: Tensor) -> Tensor:
    """The parameters `[*, 10]` of pseudo-inertias `[*, 4, 4]` [kg, kg m, kg m²]. Raises `InputError` for a shape that is none, and
    for bodies that have no parameters: those without mass, and those whose mass lies in a plane, on a line or in a point."""
    S = _checked(pseudo_inertia)
    # S = U Uᵀ with U upper triangular is the usual factorisation with rows and columns in the opposite order
    lower, failed = torch.linalg.cholesky_ex(S.flip((-2, -1)))
    U = lower.flip((-2, -1))
    diagonal = U.diagonal(dim1=-2, dim2=-1)
    size = diagonal.detach().abs().amax(-1, keepdim=True)
    flat = (failed > 0) | ~(diagonal.detach() > torch.finfo(S.dtype).eps * size).all(-1)
    if bool(flat.any()):
        raise InputError(
            f"the pseudo-inertia of {int(flat.sum())} of {flat.numel()} bodies is not positive definite: no log-Cholesky "
            "parameters (the principal moments must be positive and satisfy the triangle inequality strictly)"
        )
    scaled = U / U[..., 3:, 3:]
    spread = scaled[..., _ROWS, _COLUMNS]
    return torch.cat((U[..., 3, 3:].log(), spread[..., :3].log(), spread[..., 3:], scaled[..., :3, 3]), -1)


def pseudo_inertia_of(parameters: Tensor) -> Tensor:
    """The pseudo-inertias `[*, 4, 4]` [kg, kg m, kg m²] of log-Cholesky parameters `[*, 10]`, positive definite whatever they are.
    Raises `InputError` for a shape that is none."""
    if parameters.ndim == 0 or parameters.shape[-1] != SIZE:
        raise InputError(f"log-Cholesky parameters have shape {tuple(parameters.shape)}: must end in ({SIZE},)")
    alpha, spread, com = parameters[..., LOG_MASS], parameters[..., SPREAD], parameters[..., COM]
    (d1, d2, d3), (s12, s23, s13) = spread[..., :3].exp().unbind(-1), spread[..., 3:].unbind(-1)
    zero, one = torch.zeros_like(d1), torch.ones_like(d1)
    t1, t2, t3 = com.unbind(-1)
    entries = (d1, s12, s13, t1, zero, d2, s23, t2, zero, zero, d3, t3, zero, zero, zero, one)
    U = torch.stack(entries, -1).unflatten(-1, (4, 4))
    return (2 * alpha).exp()[..., None] * (U @ U.mT)


def mass_com_inertia(pseudo_inertia: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mass [kg] `[*]`, centre of mass [m] `[*, 3]` and inertia about it [kg m²] `[*, 3, 3]` of pseudo-inertias `[*, 4, 4]`: what
    `articulation.pseudo_inertia` was made of. Raises `InputError` for a shape that is none, and for bodies without mass."""
    S = _checked(pseudo_inertia)
    mass, first = S[..., 3, 3], S[..., :3, 3]
    com = first / mass[..., None]
    second = S[..., :3, :3] - first[..., :, None] * com[..., None, :]
    eye = torch.eye(3, dtype=S.dtype, device=S.device)
    return mass, com, second.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * eye - second


def _checked(pseudo_inertia: Tensor) -> Tensor:
    if tuple(pseudo_inertia.shape[-2:]) != (4, 4):
        raise InputError(f"the pseudo-inertia has shape {tuple(pseudo_inertia.shape)}: must end in (4, 4)")
    mass = pseudo_inertia.detach()[..., 3, 3]
    if not bool((mass > 0).all()):
        raise InputError(
            f"the smallest mass is {float(mass.min()):g} kg: must be > 0 (a body without mass has neither a centre of mass nor "
            "log-Cholesky parameters: leave it out)"
        )
    return pseudo_inertia
