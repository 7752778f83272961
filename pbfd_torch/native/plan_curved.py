"""Curved bodies as the C++ core sees them where they touch other bodies: numbers in the order in which src/bodies.h has them."""

from __future__ import annotations

import torch
from torch import Tensor

from pbfd_torch.contact.closest import RoundShape, RoundTable
from pbfd_torch.contact.polytope_pairs import PolytopePairs


def round_table(finder: PolytopePairs, one: int, other: int) -> tuple[RoundTable, bool] | None:
    """Two colliders in the frames of their bodies, the one that gives the point first, and whether that is the other one; None
    where they are not both round."""
    shapes = []
    for k in (one, other):
        polytope = finder.polytopes[k]
        if polytope.round is None:
            return None
        shapes.append(RoundShape(polytope.round, bool(polytope.flat.any()), finder.frame[k]))
    turned = shapes[1].wide < shapes[0].wide
    first, second = reversed(shapes) if turned else shapes
    return RoundTable.of([(first, second)], finder.frame), turned


def round_pair(table: RoundTable, k: int, frames: Tensor, turned: bool) -> Tensor:
    """The numbers of a pair whose bodies are at `frames` `[2, 4, 4]` on their nodes."""
    centers = (frames[:, :3, :3] @ table.shapes.centers[k][..., None]).squeeze(-1) + frames[:, :3, 3]
    around = torch.linalg.eigvalsh(table.shapes.forms[k])[:, -1].sqrt() + table.half[k]
    facts = [*table.capped[k].tolist(), turned]
    alone = centers.new_tensor([table.thin[k].item(), *map(float, facts), around.sum().item(), 1.0])
    return torch.cat((centers.flatten(), table.half[k], alone))


def row_of(forms: Tensor, axes: Tensor, frames: Tensor) -> Tensor:
    """Forms `[n, 3, 3]` and axes `[n, 3]` of shapes whose bodies are at `frames` `[n, 4, 4]` on their nodes, `[n · 12]`."""
    turn = frames[:, :3, :3]
    return torch.cat(((turn @ forms @ turn.mT).flatten(1), (turn @ axes[..., None]).squeeze(-1)), -1).flatten()


def shape_row(finder: PolytopePairs, k: int, frame: Tensor) -> Tensor:
    """Of a collider that gives points, `[12]`; what is round by its radius alone has no form besides."""
    turn = finder.frame[k, :3, :3]
    return row_of((turn @ torch.diag(finder.table.form[k]) @ turn.mT)[None], turn[None, :, 2], frame[None])
