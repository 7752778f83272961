"""Rotations against matrix exponentials, finite differences and power series, in both precisions, at zero and near half turns."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pbfd_torch.tree.rotations import (
    log_jacobian_left,
    log_jacobian_symmetric,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_matrix,
    quaternion_multiply,
    quaternion_normalize,
    rotation_log,
    sinc,
    skew,
    unskew,
)
from tests.finite_differences import derivative, right_jacobian
from tests.random_trees import generator

ANGLES = [0.0, 1e-300, 1e-12, 1e-7, 1e-4, 0.00999, 0.01001, 0.0199, 0.0201, 0.1, 1.0, 2.0, 3.0, 3.14]
DTYPES = [torch.float64, torch.float32]
both_dtypes = pytest.mark.parametrize("dtype", DTYPES, ids=["float64", "float32"])
all_angles = pytest.mark.parametrize("angle", ANGLES)


def vectors(angle: float, dtype: torch.dtype = torch.float64, count: int = 20) -> Tensor:
    """Rotation vectors of one angle about random axes, `[count, 3]`."""
    axis = torch.randn(count, 3, dtype=torch.float64, generator=generator(5))
    return (angle * axis / torch.linalg.vector_norm(axis, dim=-1, keepdim=True)).to(dtype)


def rounding(dtype: torch.dtype) -> float:
    """A few roundings of numbers of about one."""
    return 8 * torch.finfo(dtype).eps


def test_skew_is_the_cross_product() -> None:
    """[v]× w = v × w; unskew(skew(v)) = 2v, and unskew ignores the symmetric part."""
    v, w = torch.randn(2, 5, 3, dtype=torch.float64, generator=generator(1))
    torch.testing.assert_close((skew(v) @ w[..., None]).squeeze(-1), torch.linalg.cross(v, w))
    symmetric = v[..., :, None] * v[..., None, :]
    torch.testing.assert_close(unskew(skew(v) + symmetric), 2 * v)


@both_dtypes
@all_angles
def test_exponential(angle: float, dtype: torch.dtype) -> None:
    """The quaternion (cos |v|/2, sin(|v|/2) v/|v|) has unit norm and is the rotation exp([v]×)."""
    v = vectors(angle, dtype)
    q = quaternion_exp(v)
    assert q.dtype == dtype
    assert float((torch.linalg.vector_norm(q, dim=-1) - 1).abs().max()) <= rounding(dtype)
    expected = torch.linalg.matrix_exp(skew(v.double()))
    assert float((quaternion_matrix(q).double() - expected).abs().max()) <= 2 * rounding(dtype)


@pytest.mark.parametrize("turns", [1.0, 1.5, 2.0, 7.3])
def test_exponential_beyond_a_half_turn(turns: float) -> None:
    """exp is defined for any angle: exp([2π k v̂]) = 1, and so on."""
    v = vectors(2 * math.pi * turns)
    expected = torch.linalg.matrix_exp(skew(v))
    assert float((quaternion_matrix(quaternion_exp(v)) - expected).abs().max()) <= 1e-13


@both_dtypes
@all_angles
def test_quaternion_logarithm_inverts_the_exponential(angle: float, dtype: torch.dtype) -> None:
    """log(exp(v)) = v for |v| ≤ π, to relative rounding also at tiny angles; q and −q give the same."""
    v = vectors(angle, dtype)
    q = quaternion_exp(v)
    tolerance = rounding(dtype) * max(angle, float(torch.finfo(dtype).tiny))
    assert float((quaternion_log(q) - v).abs().max()) <= tolerance
    assert torch.equal(quaternion_log(-q), quaternion_log(q))


@both_dtypes
def test_quaternion_logarithm_at_a_half_turn(dtype: torch.dtype) -> None:
    """At exactly π the result is ±π v̂ (both are right), finite, and turns the body by the same rotation."""
    q = torch.cat((torch.zeros(20, 1, dtype=dtype), vectors(1.0, dtype)), -1)
    log = quaternion_log(q)
    assert float((torch.linalg.vector_norm(log, dim=-1) - math.pi).abs().max()) <= 4 * rounding(dtype)
    assert float((quaternion_matrix(quaternion_exp(log)) - quaternion_matrix(q)).abs().max()) <= 4 * rounding(dtype)


@both_dtypes
@all_angles
def test_rotation_logarithm_inverts_the_exponential(angle: float, dtype: torch.dtype) -> None:
    """log(exp([v])) = v for |v| < π: absolute rounding, which sin(angle) magnifies near the half turn."""
    v = vectors(angle, dtype)
    log = rotation_log(quaternion_matrix(quaternion_exp(v)))
    magnified = 1.0 if angle < 1 else math.pi / math.sin(angle)
    assert float((log - v).abs().max()) <= 2 * rounding(dtype) * magnified


@pytest.mark.parametrize("gap", [1e-2, 1e-3, 1e-4])
def test_rotation_logarithm_near_a_half_turn(gap: float) -> None:
    """At π − gap: relative error of the axis about eps/gap; the angle stays near π."""
    v = vectors(math.pi - gap)
    log = rotation_log(quaternion_matrix(quaternion_exp(v)))
    assert float((log - v).abs().max()) <= 30 * torch.finfo(torch.float64).eps / gap


@both_dtypes
@pytest.mark.parametrize("gap", [0.0, 1e-300, 1e-12, 1e-7])
def test_rotation_logarithm_is_finite_at_a_half_turn(gap: float, dtype: torch.dtype) -> None:
    """Closer than about 1e-6 to π the matrix does not resolve the axis: finite all the same, with finite gradient."""
    r = quaternion_matrix(quaternion_exp(vectors(math.pi - gap, dtype))).requires_grad_()
    log = rotation_log(r)
    (gradient,) = torch.autograd.grad(log.square().sum(), r)
    assert bool(torch.isfinite(log).all())
    assert bool(torch.isfinite(gradient).all())


def test_rotation_logarithm_is_continuous_near_a_half_turn() -> None:
    """rotation_log at π − a, for a from .1 down to 1e-5, is (π − a) v̂ within 1e-9: no jump where its formula changes."""
    axis = vectors(1.0, count=1)
    gaps = torch.logspace(-1, -5, 400, dtype=torch.float64)[:, None]
    v = (math.pi - gaps) * axis
    log = rotation_log(quaternion_matrix(quaternion_exp(v)))
    assert float((log - v).abs().max()) <= 1e-9


def test_quaternion_algebra() -> None:
    """R(a ⊗ b) = R(a) R(b); R(q*) = R(q)ᵀ; R does not depend on the norm of q; rotations are orthogonal with determinant 1."""
    a, b = torch.randn(2, 50, 4, dtype=torch.float64, generator=generator(2))
    torch.testing.assert_close(
        quaternion_matrix(quaternion_multiply(a, b)), quaternion_matrix(a) @ quaternion_matrix(b), rtol=0, atol=1e-14
    )
    torch.testing.assert_close(quaternion_matrix(quaternion_conjugate(a)), quaternion_matrix(a).mT, rtol=0, atol=1e-15)
    torch.testing.assert_close(quaternion_matrix(7.0 * a), quaternion_matrix(a), rtol=0, atol=1e-15)
    torch.testing.assert_close(torch.linalg.vector_norm(quaternion_normalize(a), dim=-1), torch.ones(50, dtype=torch.float64))
    torch.testing.assert_close(torch.linalg.det(quaternion_matrix(a)), torch.ones(50, dtype=torch.float64))
    quarter = quaternion_matrix(torch.tensor([1.0, 0.0, 0.0, 1.0], dtype=torch.float64))  # x → y about +z
    torch.testing.assert_close(quarter[:, 0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), rtol=0, atol=1e-15)


@both_dtypes
def test_sinc(dtype: torch.dtype) -> None:
    """sin(a)/a at small, large and zero angles, in relative precision."""
    angles = torch.tensor([1e-3, 5e-3, 0.00999, 0.01001, 0.1, 2.0, 9.0], dtype=torch.float64)
    expected = torch.sin(angles) / angles
    error = sinc((angles * angles).to(dtype)).double() - expected
    assert float(error.abs().max()) <= 4 * rounding(dtype)
    assert float(sinc(torch.zeros((), dtype=dtype))) == 1.0


# Jacobians ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.00999, 0.01001, 0.5, 2.0, 3.0])
def test_inverse_left_jacobian(angle: float) -> None:
    """d log(exp([ω]) R)/dω at ω = 0, R = exp([φ]), by central differences."""
    phi = vectors(angle, count=1)[0]
    q = quaternion_exp(phi)

    def log(omega: Tensor) -> Tensor:
        return quaternion_log(quaternion_multiply(quaternion_exp(omega), q))

    expected = derivative(log, 3)
    assert float((log_jacobian_left(phi) - expected).abs().max()) <= 1e-9


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, 2.0, 3.0])
def test_right_jacobian_of_the_checker(angle: float) -> None:
    """Jr(φ)⁻¹ = Jl(−φ)⁻¹, and Jr is the body-axes derivative of exp: log(exp(−[φ]) exp([φ + dφ])) = Jr(φ) dφ."""
    phi = vectors(angle, count=1)[0]
    back = quaternion_exp(-phi)

    def turned(delta: Tensor) -> Tensor:
        return quaternion_log(quaternion_multiply(back, quaternion_exp(phi + delta)))

    assert float((right_jacobian(phi) - derivative(turned, 3)).abs().max()) <= 1e-9
    product = right_jacobian(phi) @ log_jacobian_left(-phi)
    assert float((product - torch.eye(3, dtype=torch.float64)).abs().max()) <= 1e-13


@all_angles
def test_symmetric_jacobian(angle: float) -> None:
    """The symmetric part of the inverse left Jacobian, which is also that of the right one."""
    phi = vectors(angle)
    left = log_jacobian_left(phi)
    assert float((log_jacobian_symmetric(phi) - 0.5 * (left + left.mT)).abs().max()) <= 1e-15
    torch.testing.assert_close(log_jacobian_left(-phi), left.mT, rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 0.005, 0.3, 2.0, 3.0])
def test_symmetric_jacobian_is_the_hessian_of_half_the_squared_angle(angle: float) -> None:
    """∂²/∂δ² ½‖log(R exp([δ]))‖² at δ = 0, by automatic differentiation."""
    phi = vectors(angle, count=1)[0]
    q = quaternion_exp(phi)

    def energy(delta: Tensor) -> Tensor:
        return 0.5 * quaternion_log(quaternion_multiply(q, quaternion_exp(delta))).square().sum()

    hessian = torch.func.hessian(energy)(torch.zeros(3, dtype=torch.float64))
    assert float((log_jacobian_symmetric(phi) - hessian).abs().max()) <= 1e-10


@both_dtypes
def test_curvature_coefficient(dtype: torch.dtype) -> None:
    """c(a) = Σ |B_2n| a^{2n−2}/(2n)! = 1/12 + a²/720 + a⁴/30240 + … in I + c [φ]²: the matrix is right to rounding below a = .3."""
    for angle in (0.0, 1e-4, 0.005, 0.00999, 0.01001, 0.02, 0.1, 0.3):
        phi = vectors(angle, dtype)
        a2 = angle * angle
        c = 1 / 12 + a2 / 720 + a2**2 / 30240 + a2**3 / 1209600 + a2**4 / 47900160 + 691 * a2**5 / 1307674368000
        k = skew(phi.double())
        expected = torch.eye(3, dtype=torch.float64) + c * (k @ k)
        assert float((log_jacobian_symmetric(phi).double() - expected).abs().max()) <= rounding(dtype)


# Derivatives ----------------------------------------------------------------------------------------------------------


def _square(m: Tensor) -> Tensor:
    return m.square().sum() + m.sum()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.0099, 0.0101, 0.7, 2.5])
def test_gradients(angle: float) -> None:
    """First and second derivatives by automatic differentiation equal differences, at zero rotation as well."""
    phi = vectors(angle, count=2).requires_grad_()
    q = quaternion_exp(phi).detach().requires_grad_()
    r = quaternion_matrix(q).detach().requires_grad_()
    for function, at in (
        (quaternion_exp, phi),
        (quaternion_matrix, q),
        (quaternion_normalize, q),
        (rotation_log, r),
        (log_jacobian_left, phi),
        (log_jacobian_symmetric, phi),
    ):
        assert torch.autograd.gradcheck(function, at, atol=1e-7)
        assert torch.autograd.gradgradcheck(function, at, atol=1e-5, rtol=1e-4)
    tangent = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)

    def through(delta: Tensor) -> Tensor:
        return quaternion_log(quaternion_multiply(q.detach(), quaternion_exp(delta)))

    assert torch.autograd.gradcheck(through, tangent, atol=1e-7)
    assert torch.autograd.gradgradcheck(through, tangent, atol=1e-5, rtol=1e-4)


@both_dtypes
def test_gradients_at_zero_rotation_are_exact(dtype: torch.dtype) -> None:
    """At v = 0: d exp/dv = (0, ½·1); d log/d(xyz) = 2·1; d rotation_log(exp)/dv = 1; all finite, no 0/0."""
    zero = torch.zeros(3, dtype=dtype)
    exp = torch.func.jacrev(quaternion_exp)(zero)
    expected = torch.cat((torch.zeros(1, 3), 0.5 * torch.eye(3))).to(dtype)
    assert torch.equal(exp, expected)
    log = torch.func.jacrev(quaternion_log)(torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=dtype))
    assert torch.equal(log[:, 1:], 2 * torch.eye(3, dtype=dtype))
    assert bool((log[:, 0] == 0).all())
    chain = torch.func.jacrev(lambda v: rotation_log(quaternion_matrix(quaternion_exp(v))))(zero)
    assert torch.equal(chain, torch.eye(3, dtype=dtype))


@both_dtypes
def test_batch_shapes(dtype: torch.dtype) -> None:
    """Every function takes any leading shape and keeps the dtype; a batch gives what its rows give."""
    for shape in ((), (3,), (2, 3), (0,)):
        v = torch.randn(*shape, 3, dtype=dtype, generator=generator(3))
        q = quaternion_exp(v)
        assert q.shape == (*shape, 4)
        assert quaternion_matrix(q).shape == (*shape, 3, 3)
        for log in (quaternion_log(q), rotation_log(quaternion_matrix(q))):
            assert log.shape == v.shape
            assert log.dtype == dtype
        assert log_jacobian_left(v).shape == (*shape, 3, 3)
    v = torch.randn(4, 3, dtype=dtype, generator=generator(4))
    assert all(torch.equal(quaternion_exp(v)[k], quaternion_exp(v[k])) for k in range(4))
