"""Sums over the candidates of each link. No atomics: what they add up depends on who comes first."""

from __future__ import annotations

import torch
from torch import Tensor


def belonging(link: Tensor, links: int, like: Tensor) -> Tensor:
    """1 where a candidate is the link's, else 0, `[*, n] → [*, links, n]`, of the type of `like`."""
    return (torch.arange(links, device=link.device)[:, None] == link[..., None, :]).to(like.dtype)


def summed(on: Tensor, of_candidates: Tensor) -> Tensor:
    """Sums over what is `on` each link, `[*, links, n], [*batch, n, r, c] → [*batch, links, r, c]`; row by row the same in any
    batch."""
    on = on.expand(*of_candidates.shape[:-3], *on.shape[-2:])
    return (on @ of_candidates.flatten(-2)).unflatten(-1, of_candidates.shape[-2:])
