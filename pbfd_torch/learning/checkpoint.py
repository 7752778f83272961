"""What a training has saved: read without running anything that the file brings along, and checked before it is used."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pbfd_torch.errors import InputError
from pbfd_torch.learning import curve
from pbfd_torch.learning.numbers import require_integer, require_real
from pbfd_torch.learning.settings import WIDTHS
from pbfd_torch.learning.training_env import EnvSettings

FORMAT = "pbfd_torch policy 1"
_MOMENTS = ("exp_avg", "exp_avg_sq")


def load_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's contents: "method", "settings" (with "env" and "width"), "rows", "seconds", "random", and the states of what
    learns, which `load_weights`, `load_moments` and `checked_statistics` check against what they are for. Tensors are on the CPU.

    Raises `InputError` for what is none, naming the field, its value and its range."""
    try:
        saved = torch.load(path, weights_only=True, map_location="cpu")
    except FileNotFoundError:
        raise InputError(f"no checkpoint at '{path}'") from None
    except Exception as error:  # pickle, zipfile and torch raise whatever they like on damaged files
        words = str(error).splitlines() or [type(error).__name__]
        raise InputError(f"'{path}' is not a readable checkpoint: {words[0]}") from error
    try:
        return _checked(saved)
    except InputError as error:
        raise InputError(f"'{path}' is not a usable checkpoint: {error}") from error


def _checked(saved: object) -> dict[str, Any]:
    found = dict(require_mapping("it", saved))
    if found.get("format") != FORMAT:
        raise InputError(f"it has format {reprlib.repr(found.get('format'))}: must be {FORMAT!r}")
    if not isinstance(found.get("method"), str):
        raise InputError(f"method is {reprlib.repr(found.get('method'))}: must be a text")
    settings = require_mapping("settings", found.get("settings"))
    EnvSettings.of(require_mapping("settings.env", settings.get("env")))
    require_integer("settings.width", settings.get("width"), *WIDTHS)
    curve.rows_of(found.get("rows"))
    require_real("seconds", found.get("seconds"), 0, 1e12)
    state = torch.get_rng_state()
    require_tensor("random", found.get("random"), state)
    return found


def load_weights(name: str, module: nn.Module, saved: object) -> None:
    """Gives a network what was saved of it. Raises `InputError` naming the weight that is missing or does not fit."""
    wanted, given = module.state_dict(), require_mapping(name, saved)
    _require_keys(name, given, set(wanted))
    for key, like in wanted.items():
        require_tensor(f"{name}.{key}", given[key], like)
    module.load_state_dict(dict(given))


def load_moments(name: str, optimiser: torch.optim.Optimizer, saved: object) -> None:
    """Gives an Adam what was saved of its moments; its settings stay its own. Raises `InputError` as `load_weights` does."""
    moments = require_mapping(f"{name}.state", require_mapping(name, saved).get("state"))
    parameters = [x for group in optimiser.param_groups for x in group["params"]]
    for k, given in moments.items():
        require_integer(f"a key of {name}.state", k, 0, len(parameters) - 1)
        given = require_mapping(f"{name}.state.{k}", given)
        _require_keys(f"{name}.state.{k}", given, {"step", *_MOMENTS})
        require_tensor(f"{name}.state.{k}.step", given["step"], torch.zeros(()))
        for what in _MOMENTS:
            require_tensor(f"{name}.state.{k}.{what}", given[what], parameters[k])
        for what in ("step", "exp_avg_sq"):
            _require_least(f"{name}.state.{k}.{what}", given[what], 0)
    optimiser.load_state_dict({"state": dict(moments), "param_groups": optimiser.state_dict()["param_groups"]})


def checked_statistics(saved: object, width: int) -> dict[str, dict[str, Tensor]]:
    """The running statistics of `width` observations. Raises `InputError` as `load_weights` does."""
    given = require_mapping("statistics", saved)
    likes = {"loc": torch.zeros(width), "var": torch.zeros(width), "count": torch.zeros((), dtype=torch.int64)}
    _require_keys("statistics", given, set(likes))
    for key, like in likes.items():
        require_tensor(f"statistics.{key}.observation", require_mapping(f"statistics.{key}", given[key]).get("observation"), like)
    _require_least("statistics.var.observation", given["var"]["observation"], 0)
    _require_least("statistics.count.observation", given["count"]["observation"], 1)
    return {key: dict(value) for key, value in given.items()}


def require_mapping(name: str, value: object) -> Mapping[Any, Any]:
    """Raises `InputError` unless it is a dictionary."""
    if not isinstance(value, Mapping):
        raise InputError(f"{name} is {_shown(value)}: must be a dictionary")
    return value


def require_tensor(name: str, value: object, like: Tensor) -> None:
    """Raises `InputError` unless it is a plain tensor of the same shape and type, with finite numbers."""
    wanted = f"a tensor of {like.dtype} with shape {tuple(like.shape)}"
    # the shape comes first: a small file may claim a large one
    if not isinstance(value, Tensor) or value.layout != torch.strided or value.is_quantized or value.is_meta:
        raise InputError(f"{name} is {_shown(value)}: must be {wanted}")
    if value.shape != like.shape or value.dtype != like.dtype:
        raise InputError(f"{name} is {_shown(value)}: must be {wanted}")
    if not bool(value.isfinite().all()):
        raise InputError(f"{name} holds {float(value[~value.isfinite()][0])}: must be finite")


def _require_least(name: str, value: Tensor, least: float) -> None:
    if bool((value < least).any()):
        raise InputError(f"{name} holds {float(value.min())}: must be ≥ {least}")


def _require_keys(name: str, given: Mapping[Any, Any], wanted: set[str]) -> None:
    if wrong := wanted ^ set(given):
        which = ", ".join(sorted(map(str, wrong))[:3])
        raise InputError(f"{name} has not the entries it must have: {which} is missing or too much")


def _shown(value: object) -> str:
    if isinstance(value, Tensor):
        return f"a tensor of {value.dtype} with shape {tuple(value.shape)}"
    return reprlib.repr(value)
