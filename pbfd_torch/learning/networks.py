"""Policy and value networks, as torchrl's losses expect them."""

from __future__ import annotations

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

SEEN = "seen"  # the key of the normalised observation
_START_SCALE = -0.5  # log of the action's spread at the start


def make_actor(observations: int, actions: Bounded, width: int = 64) -> ProbabilisticActor:
    """A Gaussian through tanh within the bounds of `actions`; its spread does not depend on what is seen."""
    low, high = (x.reshape(-1, x.shape[-1])[0] for x in (actions.space.low, actions.space.high))
    count = low.shape[-1]
    body = _body(observations, count, width, 0.01)
    head = AddStateIndependentNormalScale(count, scale_mapping="exp", init_value=_START_SCALE)
    module = TensorDictModule(nn.Sequential(body, head), in_keys=[SEEN], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        module,
        in_keys=["loc", "scale"],
        spec=None,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": high, "tanh_loc": False},
        return_log_prob=True,
    )


def make_critic(observations: int, width: int = 64) -> ValueOperator:
    """The value of what is seen."""
    return ValueOperator(_body(observations, 1, width, 1.0), in_keys=[SEEN])


def _body(inputs: int, outputs: int, width: int, last: float) -> MLP:
    """Two hidden layers; orthogonal weights, of gain `last` in the last layer."""
    body = MLP(inputs, outputs, num_cells=[width, width], activation_class=nn.Tanh)
    for layer in body:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, 1.4 if layer.out_features == width else last)
            nn.init.zeros_(layer.bias)
    return body


def mean_action(actor: ProbabilisticActor, seen: torch.Tensor) -> torch.Tensor:
    """What the policy does without noise, `[*batch, nu]`."""
    from tensordict import TensorDict

    parameters = actor.get_dist_params(TensorDict({SEEN: seen}, seen.shape[:-1]))
    action: torch.Tensor = actor.build_dist_from_params(parameters).deterministic_sample
    return action
