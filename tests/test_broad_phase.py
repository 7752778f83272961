"""The broad phase gives the pairs whose boxes overlap, touching ones included, in every world."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pbfd_torch.contact.broad_phase import overlapping
from tests.random_trees import generator


def near(lower: Tensor, upper: Tensor) -> Tensor:
    """Of all pairs."""
    count = lower.shape[-2]
    first, second = torch.triu_indices(count, count, 1)
    return overlapping(lower, upper, first, second)


def boxes(batch: tuple[int, ...], count: int, side: float, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Lower and upper corners of boxes of .2 to .8 m in a cube."""
    random = generator(1)
    middle = side * torch.rand(*batch, count, 3, dtype=dtype, generator=random)
    half = 0.1 + 0.3 * torch.rand(*batch, count, 3, dtype=dtype, generator=random)
    return middle - half, middle + half


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3)], ids=str)
def test_boxes_that_share_room_are_near(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    lower, upper = boxes(batch, 40, 2.5, dtype)
    found = near(lower, upper)
    one, other = torch.triu_indices(40, 40, 1)
    shared = torch.minimum(upper[..., one, :], upper[..., other, :]) - torch.maximum(lower[..., one, :], lower[..., other, :])
    expected = (shared >= 0).all(-1)
    assert 0 < int(expected.sum()) < 0.5 * expected.numel()
    assert found.shape == (*batch, 780)
    assert bool((found == expected).all())


@pytest.mark.parametrize(("shift", "touching"), [(1.0, True), (1.0 + 2**-40, False), (1.0 - 2**-40, True)])
def test_touching_boxes_are_near(shift: float, touching: bool) -> None:
    lower = torch.tensor([[0.0, 0, 0], [shift, 0, 0]], dtype=torch.float64)
    assert near(lower, lower + 1).tolist() == [touching]


def test_only_the_given_pairs_are_asked_for() -> None:
    """All boxes overlap; pairs come in the order and the sense in which they are given."""
    pairs = torch.tensor([3, 0]), torch.tensor([1, 2])
    lower = 0.1 * torch.arange(4, dtype=torch.float64)[:, None].expand(4, 3)
    assert overlapping(lower, lower + 1, *pairs).tolist() == [True, True]
    apart = lower + torch.tensor([0.0, 0, 0, 5], dtype=torch.float64)[:, None]
    assert overlapping(apart, apart + 1, *pairs).tolist() == [False, True]


def test_worlds_do_not_see_each_other() -> None:
    lower, upper = boxes((4,), 12, 1.5)
    together = near(lower, upper)
    assert bool((together == torch.stack([near(a, b) for a, b in zip(lower, upper, strict=True)])).all())


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_nothing_is_near_what_is_not_finite(bad: float) -> None:
    """A world with NaN or infinity has no pairs, and the others have theirs."""
    lower, upper = boxes((3,), 10, 1.0)
    expected = near(lower, upper)
    lower[1], upper[1] = bad, torch.nan
    found = near(lower, upper)
    assert not bool(found[1].any())
    assert bool((found[[0, 2]] == expected[[0, 2]]).all())
    assert bool(expected.any())
