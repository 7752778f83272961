"""Both broad phases give the same pairs: those whose boxes overlap, touching ones included, in every world."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.broad_phase import AllPairs, BroadPhase, FclTree
from tests.random_trees import generator

KINDS: list[type[AllPairs | FclTree]] = [AllPairs, FclTree]


def of_all(kind: type[AllPairs | FclTree], count: int) -> BroadPhase:
    first, second = torch.triu_indices(count, count, 1)
    return kind(first, second)


def boxes(batch: tuple[int, ...], count: int, side: float, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Lower and upper corners of boxes of .2 to .8 m in a cube."""
    random = generator(1)
    middle = side * torch.rand(*batch, count, 3, dtype=dtype, generator=random)
    half = 0.1 + 0.3 * torch.rand(*batch, count, 3, dtype=dtype, generator=random)
    return middle - half, middle + half


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3)], ids=str)
def test_both_agree(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    lower, upper = boxes(batch, 40, 2.5, dtype)
    found = [of_all(kind, 40).near(lower, upper) for kind in KINDS]
    one, other = torch.triu_indices(40, 40, 1)
    shared = torch.minimum(upper[..., one, :], upper[..., other, :]) - torch.maximum(lower[..., one, :], lower[..., other, :])
    expected = (shared >= 0).all(-1)
    assert 0 < int(expected.sum()) < 0.5 * expected.numel()
    assert found[0].shape == found[1].shape == (*batch, 780)
    assert bool((found[0] == expected).all())
    assert bool((found[1] == expected).all())


def test_both_agree_on_boxes_with_one_centre() -> None:
    """FCL's boxes are told apart by where they are: here several are at one place, in other pairs than they overlap."""
    middle = torch.tensor([0.0, 0, 0, 1, 1, 3], dtype=torch.float64)[:, None] * torch.ones(3, dtype=torch.float64)
    half = torch.tensor([0.6, 0.1, 0.2, 0.5, 0.1, 1.2], dtype=torch.float64)[:, None]
    found = [of_all(kind, 6).near(middle - half, middle + half) for kind in KINDS]
    one, other = torch.triu_indices(6, 6, 1)
    expected = (middle[one, 0] - middle[other, 0]).abs() <= half[one, 0] + half[other, 0]
    assert 0 < int(expected.sum()) < 15
    assert bool((found[0] == expected).all())
    assert bool((found[1] == expected).all())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("shift", "near"), [(1.0, True), (1.0 + 2**-40, False), (1.0 - 2**-40, True)])
def test_touching_boxes_are_near(kind: type[AllPairs | FclTree], shift: float, near: bool) -> None:
    lower = torch.tensor([[0.0, 0, 0], [shift, 0, 0]], dtype=torch.float64)
    assert of_all(kind, 2).near(lower, lower + 1).tolist() == [near]


@pytest.mark.parametrize("kind", KINDS)
def test_only_the_given_pairs_are_asked_for(kind: type[AllPairs | FclTree]) -> None:
    """All boxes overlap; pairs come in the order and the sense in which they are given."""
    phase = kind(torch.tensor([3, 0]), torch.tensor([1, 2]))
    lower = 0.1 * torch.arange(4, dtype=torch.float64)[:, None].expand(4, 3)
    assert phase.near(lower, lower + 1).tolist() == [True, True]
    apart = lower + torch.tensor([0.0, 0, 0, 5], dtype=torch.float64)[:, None]
    assert phase.near(apart, apart + 1).tolist() == [False, True]


@pytest.mark.parametrize("kind", KINDS)
def test_worlds_do_not_see_each_other(kind: type[AllPairs | FclTree]) -> None:
    lower, upper = boxes((4,), 12, 1.5)
    phase = of_all(kind, 12)
    together = phase.near(lower, upper)
    assert bool((together == torch.stack([phase.near(a, b) for a, b in zip(lower, upper, strict=True)])).all())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_nothing_is_near_what_is_not_finite(kind: type[AllPairs | FclTree], bad: float) -> None:
    """A world with NaN or infinity has no pairs, and the others have theirs."""
    lower, upper = boxes((3,), 10, 1.0)
    expected = of_all(kind, 10).near(lower, upper)
    lower[1], upper[1] = bad, torch.nan
    found = of_all(kind, 10).near(lower, upper)
    assert not bool(found[1].any())
    assert bool((found[[0, 2]] == expected[[0, 2]]).all())
    assert bool(expected.any())
