"""What steps depend on besides the state and the control, and a stepper of other values of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from pbfd_torch.integrators.integrator import S
from pbfd_torch.stepping.eager import EagerStepper
from pbfd_torch.tensors.plain import carries
from pbfd_torch.tensors.structures import in_dtype, tensors_of
from pbfd_torch.tensors.worlds import replaced
from pbfd_torch.terms.load import Term
from pbfd_torch.tree.articulation import Articulation


@dataclass(frozen=True, eq=False)
class Parts:
    """What a stepper's steps depend on besides the state and the control; adapted: the terms as they act in a step."""

    articulation: Articulation
    terms: Sequence[Term]
    gravity: Tensor
    step_size: Tensor
    adapted: Sequence[Term]


class Carriers:
    """All tensors that a stepper's steps depend on besides the state and the control, to be asked before every step and start."""

    def __init__(self, stepper: EagerStepper[Any]) -> None:
        scene = stepper.scene
        self._tensors = tensors_of(Parts(scene.articulation, scene.terms, scene.gravity, stepper.step_size, ()))

    def may_carry(self, *given: Any) -> bool:
        """Whether what is made of the tensors among these may carry derivatives, or torch.func may be at work. The common case,
        that it does not, is known without a look at each tensor's tangents."""
        if forward_ad._current_level >= 0 or torch._C._functorch.peek_interpreter_stack() is not None:
            return True
        if not torch.is_grad_enabled():
            return False
        return any(x.requires_grad for x in self._tensors) or any(x.requires_grad for x in given if isinstance(x, Tensor))


def parts_of(stepper: EagerStepper[S]) -> Parts:
    """Those of a stepper; where they carry derivatives, so do the adapted terms."""
    scene, terms = stepper.scene, stepper.terms
    parts = Parts(scene.articulation, scene.terms, scene.gravity, stepper.step_size, scene.terms)
    if any(map(carries, tensors_of(parts))):
        terms = stepper.integrator.adapted(scene.articulation, scene.terms, stepper.step_size)
    return replaced(parts, adapted=terms)


def of_parts(stepper: EagerStepper[S], parts: Parts) -> EagerStepper[S]:
    """The same stepper made of other values of its parts."""
    scene = replaced(stepper.scene, articulation=parts.articulation, terms=parts.terms, gravity=parts.gravity)
    return stepper.changed(scene=scene, step_size=parts.step_size, terms=parts.adapted)


def precise(stepper: EagerStepper[S]) -> EagerStepper[S]:
    """The same stepper in float64, itself if it is."""
    if stepper.articulation.dtype == torch.float64:
        return stepper
    scene = stepper.scene
    parts = Parts(scene.articulation, scene.terms, scene.gravity, stepper.step_size, stepper.terms)
    return of_parts(stepper, in_dtype(parts, torch.float64)).changed(scale=stepper.scale.double())
