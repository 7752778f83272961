"""Log-Cholesky parameters: every ten numbers are a physical body, and every body is ten numbers."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pbfd_torch import InputError
from pbfd_torch.models import SCENES
from pbfd_torch.tree.articulation import pseudo_inertia
from pbfd_torch.tree.inertial import log_cholesky, mass_com_inertia, pseudo_inertia_of


def random_parameters(*batch: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> Tensor:
    """Masses over four orders of magnitude, bodies of a centimetre to a metre."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(*batch, 10, generator=generator, dtype=torch.float64)
    return torch.cat((x[..., :1], x[..., 1:4] - 2.5, 0.1 * x[..., 4:]), -1).to(dtype)


@pytest.mark.parametrize("batch", [(), (7,), (2, 3)])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-3)])
def test_round_trip(batch: tuple[int, ...], dtype: torch.dtype, tolerance: float) -> None:
    parameters = random_parameters(*batch, dtype=dtype)
    S = pseudo_inertia_of(parameters)
    assert S.shape == (*batch, 4, 4)
    assert S.dtype == dtype
    torch.testing.assert_close(log_cholesky(S), parameters, rtol=0, atol=tolerance)
    scale = S.abs().amax((-2, -1), keepdim=True)
    assert float(((pseudo_inertia_of(log_cholesky(S)) - S) / scale).abs().max()) < tolerance


@pytest.mark.parametrize("scene", ["hopper", "box-slide", "dzhanibekov"])
def test_round_trip_of_real_links(scene: str) -> None:
    S = SCENES[scene](1).scene.articulation.pseudo_inertia
    torch.testing.assert_close(pseudo_inertia_of(log_cholesky(S)), S, rtol=1e-12, atol=1e-15)


def test_every_ten_numbers_are_a_body() -> None:
    """S is positive definite, and so the principal moments satisfy the triangle inequality."""
    S = pseudo_inertia_of(random_parameters(1000))
    mass, _, inertia = mass_com_inertia(S)
    assert bool((mass > 0).all())
    scale = S.diagonal(dim1=-2, dim2=-1).rsqrt()
    assert float(torch.linalg.eigvalsh(scale[..., None] * S * scale[..., None, :]).min()) > 0
    moments = torch.linalg.eigvalsh(inertia)
    assert float(moments.min()) > 0
    assert float(((moments[..., 0] + moments[..., 1]) / moments[..., 2]).min()) > 1


def test_meaning_of_the_numbers() -> None:
    parameters = random_parameters(50)
    S = pseudo_inertia_of(parameters)
    mass, com, inertia = mass_com_inertia(S)
    torch.testing.assert_close(mass, (2 * parameters[:, 0]).exp())
    torch.testing.assert_close(com, parameters[:, 7:])
    torch.testing.assert_close(pseudo_inertia(mass, com, inertia), S, rtol=1e-12, atol=1e-14)
    moved = parameters.clone()
    moved[:, 0] += 0.5
    moved[:, 7:] += 0.3
    _, _, heavier = mass_com_inertia(pseudo_inertia_of(moved))
    torch.testing.assert_close(heavier, torch.e * inertia)  # the same spread about the centre of mass


def test_derivatives() -> None:
    # bodies of about a metre, so that differences are not lost in rounding
    parameters = (random_parameters(3) * torch.tensor([0.5, 0.2, 0.2, 0.2, *[1.0] * 6])).requires_grad_()
    assert torch.autograd.gradcheck(pseudo_inertia_of, parameters, check_forward_ad=True, check_batched_grad=True)
    S = pseudo_inertia_of(parameters.detach()).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: log_cholesky(0.5 * (x + x.mT)), S, check_forward_ad=True)
    assert torch.autograd.gradcheck(mass_com_inertia, S, check_forward_ad=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_derivatives_are_finite_at_the_extremes(dtype: torch.dtype) -> None:
    """Bodies of a milligram to 1000 t, a tenth of a millimetre to ten metres, far from their frame's origin or at it."""
    alpha = torch.tensor([-7.0, 0.0, 7.0], dtype=dtype)
    spread = torch.tensor([-9.0, 0.0, 2.3], dtype=dtype)
    com = torch.tensor([0.0, 10.0], dtype=dtype)
    grid = torch.cartesian_prod(alpha, spread, com)
    parameters = torch.cat(
        (grid[:, :1], grid[:, 1:2].expand(-1, 3), torch.zeros(len(grid), 3, dtype=dtype), grid[:, 2:].expand(-1, 3)), -1
    )
    parameters.requires_grad_()
    pseudo_inertia_of(parameters).sum().backward()
    assert parameters.grad is not None
    assert bool(torch.isfinite(parameters.grad).all())


@pytest.mark.parametrize(
    ("mass", "inertia", "message"),
    [
        (0.0, (0.0, 0.0, 0.0), "without mass"),
        (-1.0, (0.1, 0.1, 0.1), "must be > 0"),
        (1.0, (0.0, 0.0, 0.0), "not positive definite"),  # a point
        (1.0, (0.0, 0.1, 0.1), "not positive definite"),  # a line
        (1.0, (0.1, 0.1, 0.2), "triangle inequality strictly"),  # a plate
        (1.0, (0.1, 0.1, 0.3), "triangle inequality strictly"),  # no body
    ],
)
def test_what_is_not_physical(mass: float, inertia: tuple[float, float, float], message: str) -> None:
    S = pseudo_inertia(torch.tensor(mass).double(), torch.zeros(3).double(), torch.diag(torch.tensor(inertia)).double())
    with pytest.raises(InputError, match=message):
        log_cholesky(S)


def test_shapes_are_checked() -> None:
    with pytest.raises(InputError, match=r"must end in \(10,\)"):
        pseudo_inertia_of(torch.zeros(3, 9))
    with pytest.raises(InputError, match=r"must end in \(4, 4\)"):
        log_cholesky(torch.eye(3))
    with pytest.raises(InputError, match="must be > 0"):
        mass_com_inertia(torch.zeros(4, 4))
