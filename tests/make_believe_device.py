"""A make-believe device: what CUDA would complain about, wait for and launch, counted on a machine without one.

Its tensors claim to be on `DEVICE` and hold their values in the host's memory, where every operation is really done; so numbers
come out as on the CPU, while code that asks where a tensor is takes the way that it takes on CUDA.

    with make_believe():
        setup = SCENES["hopper"](worlds=3, device=DEVICE)
        ...
        with make_believe() as tally:  # an inner one counts for itself
            simulator.step(state)
    print(tally.launches, tally.waits, tally.copies)

What waits is written down here from the CUDA sources of PyTorch 2.13. Where those choose by the number of worlds, the choice for
many counts, as tests have few. A linear algebra routine that nobody has looked up raises `NotImplementedError`.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

import pbfd_torch

PACKAGE = os.path.dirname(pbfd_torch.__file__)


class _Module:
    """`torch.make_believe`, which PyTorch asks about its devices: it has none, so that nobody else in the process takes one."""

    def is_available(self) -> bool:
        return False

    def device_count(self) -> int:
        return 0

    def current_device(self) -> int:
        return 0

    def is_initialized(self) -> bool:
        return True

    def _is_in_bad_fork(self) -> bool:
        return False

    def manual_seed_all(self, seed: int) -> None:
        pass


class _Hook(torch._C._acc.PrivateUse1Hooks):
    """The same for the side of PyTorch that is written in C++."""

    def is_available(self) -> bool:
        return False

    def is_built(self) -> bool:
        return True

    def has_primary_context(self, index: int) -> bool:
        return True


_setup_privateuseone_for_python_backend("make_believe", _Module(), _Hook())
DEVICE = torch.device("make_believe:0")

# What waits ---------------------------------------------------------------------------------------------------------------

# The host must see a number, or how large the result is, before it goes on.
READS = {
    "_local_scalar_dense": "item",
    "equal": "equal",
    "allclose": "allclose",
    "nonzero": "nonzero",
    "masked_select": "masked_select",
    "bincount": "bincount",
    "unique_dim": "unique",
    "unique_consecutive": "unique",
    "_unique": "unique",
    "_unique2": "unique",
}
# These look at cuSOLVER's report of errors on the host, and have no variant that does not.
CHECKS = {"_linalg_check_errors": "check of errors", "_linalg_eigh": "eigh", "_linalg_svd": "svd", "_linalg_eig": "eig"}
# Up to 16 unknowns are factored by cuBLAS, for all worlds at once. More go to MAGMA where there are more than 16 matrices: it ends
# with a wait for its queue, and cannot be recorded as a graph.
LU = ("linalg_lu_factor_ex", "_linalg_solve_ex", "linalg_inv_ex", "_linalg_det", "_linalg_slogdet")
LARGEST_LU = 16
# Done for all worlds at once by cuBLAS, cuSOLVER or PyTorch, errors unseen. QR: where no factor Q is asked for, up to 256 rows.
HARMLESS = (
    "geqrf",
    "linalg_qr",
    "linalg_cholesky_ex",
    "linalg_solve_triangular",
    "linalg_lu_solve",
    "linalg_vector_norm",
    "linalg_cross",
)

# Nobody has looked these up yet, nor the rest of `linalg`: none of them is used in a step.
LINEAR_ALGEBRA = ("ormqr", "orgqr", "cholesky_solve", "cholesky_inverse", "lu_unpack")
INDEXING = ("index", "index_put", "index_put_")

# What is launched ---------------------------------------------------------------------------------------------------------

# Kernels, about, of operations that are more than one: copies into columns, arrays of pointers, and what cuBLAS itself launches.
SEVERAL = {
    "linalg_lu_factor_ex": 4,
    "linalg_lu_solve": 6,
    "_linalg_solve_ex": 10,
    "linalg_inv_ex": 12,
    "_linalg_det": 6,
    "_linalg_slogdet": 8,
    "geqrf": 5,
    "linalg_cholesky_ex": 4,
    "linalg_solve_triangular": 5,
    "sort": 2,
}
# Memory, but no kernel; views, which PyTorch's schemas tell by themselves, launch none either.
UNLAUNCHED = ("empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "_unsafe_view", "_local_scalar_dense")


@dataclass
class Tally:
    """What a device was asked for. launches: kernels, about. waits: what the host had to wait for, with the line of ours that did
    it, and how often; copies: between host and device, likewise."""

    launches: int = 0
    waits: Counter[str] = field(default_factory=Counter)
    copies: Counter[str] = field(default_factory=Counter)


class MixedDevicesError(RuntimeError):
    """Tensors of both the host and the device in one operation."""


class Pretender(Tensor):
    """A tensor that claims to be on `DEVICE`; `held`: its values. `number`: PyTorch has made it of a Python number by itself."""

    held: Tensor
    number: bool

    @staticmethod
    def __new__(cls, held: Tensor) -> Self:
        made = Tensor._make_wrapper_subclass(
            cls, held.size(), strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype, device=DEVICE
        )
        made.held, made.number = held, False
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        raise RuntimeError(f"{function} of a make-believe tensor outside `make_believe()`")

    def __repr__(self, *, tensor_contents: Any = None) -> str:  # type: ignore[override]
        return f"Pretender({self.held!r})"

    def tolist(self) -> Any:
        """Counted as the copy that it is."""
        return self.cpu().tolist()

    def numpy(self, *, force: bool = False) -> Any:
        """As on CUDA: raises `TypeError`."""
        raise TypeError("can't convert a make-believe tensor to numpy: use Tensor.cpu() to copy it to the host first")


def values(tensor: Tensor) -> Tensor:
    """What a tensor of the device holds, uncounted; one of the host itself."""
    return tensor.held if isinstance(tensor, Pretender) else tensor


@contextlib.contextmanager
def make_believe() -> Iterator[Tally]:
    """Has the device at hand, and counts what it is asked for."""
    lifted = torch._C._only_lift_cpu_tensors()
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor makes its tensors on the host, and copies them where we see it
    device = _Device()
    try:
        # the engine for gradients has no thread for a device that came after its first use
        with device, torch.autograd.set_multithreading_enabled(False):
            yield device.tally
    finally:
        torch._C._set_only_lift_cpu_tensors(lifted)


class _Device(TorchDispatchMode):
    """Does every operation on the values held, and notes what it would have asked of a device."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.tally = Tally()

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Nothing is compiled here: to hide every operation from the compiler would take as long as to do it."""
        return False

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        tensors = _tensors([*args, *kwargs.values()])
        pretenders = [x for x in tensors if isinstance(x, Pretender)]
        target = kwargs.get("device")
        aimed = target is not None and torch.device(target).type == DEVICE.type
        if not (pretenders or aimed):
            return function(*args, **kwargs)
        operation = _operation(function)
        if len(pretenders) < len(tensors):
            self._check(operation, args, [x for x in tensors if not isinstance(x, Pretender)])
        self._note(operation, args, kwargs)
        changed = {key: _held(x) for key, x in kwargs.items()}
        if target is not None:
            changed["device"] = torch.device("cpu")
        result = function(*map(_held, args), **changed)
        if not aimed and target is not None:
            return result
        if operation.writes:  # gives back what it was given
            known = {id(x.held): x for x in pretenders}
            return _mapped(lambda x: known.get(id(x), x), result)
        claimed = Pretender(result) if type(result) is Tensor else _mapped(Pretender, result)
        if operation.name == "scalar_tensor":
            claimed.number = True
        return claimed

    def _check(self, operation: _Operation, args: Sequence[Any], host: Sequence[Tensor]) -> None:
        """Raises `MixedDevicesError` for what PyTorch does not mix with the host's tensors, and notes what it copies to mix it."""
        name = operation.name
        if name in ("_to_copy", "copy_"):
            return
        if not isinstance(args[0], Pretender) and (operation.writes or name == "index"):
            raise MixedDevicesError(f"{name} changes or reads a tensor of the host by tensors of the device")
        if name in INDEXING:
            found = [x for x in args[1] if x is not None and not isinstance(x, Pretender)]
            if len(found) < len(host) and args[2].dim() > 0:
                raise MixedDevicesError(f"{name} puts values of the host into a tensor of the device")
            for _ in found:
                self._copy("index to the device")
        elif not (operation.takes_numbers and all(x.dim() == 0 for x in host)):
            raise MixedDevicesError(f"{name} of tensors on both devices: those of the host are {[tuple(x.shape) for x in host]}")

    def _note(self, operation: _Operation, args: Sequence[Any], kwargs: dict[str, Any]) -> None:
        """Counts what the operation asks for."""
        name = operation.name
        copied = _copied(name, args, kwargs)
        if copied:
            self._copy(copied)
            return
        if name in INDEXING:
            self._note_index(name, args)
        waits = _waits(name, args, kwargs)
        if waits:
            self._wait(waits)
        self.tally.launches += operation.launches

    def _note_index(self, name: str, args: Sequence[Any]) -> None:
        indices = [x for x in args[1] if x is not None]
        masked = any(x.dtype in (torch.bool, torch.uint8) for x in indices)
        if name != "index" and values(args[2]).dim() == 0 and (not isinstance(args[2], Pretender) or args[2].number):
            # on CUDA a Python number becomes a tensor of the host; under a single mask it is filled in, else it is copied first
            if masked and len(indices) == 1:
                return
            self._copy("number to the device")
        if masked:
            self._wait(f"{name} by mask")

    def _wait(self, what: str) -> None:
        self.tally.waits[f"{what} at {_line()}"] += 1

    def _copy(self, what: str) -> None:
        self.tally.copies[f"{what} at {_line()}"] += 1


class _Operation(NamedTuple):
    """What is known of one of PyTorch's operations. writes: into an argument; takes_numbers: a 0-dimensional tensor of the host may
    stand for a number, which CUDA's kernels take as an argument."""

    name: str
    launches: int
    writes: bool
    takes_numbers: bool


@functools.cache
def _operation(function: Any) -> _Operation:
    name, schema = str(function.overloadpacket.__name__), function._schema
    view = any(x.alias_info is not None and not x.alias_info.is_write for x in schema.returns)
    return _Operation(
        name,
        0 if view or name in UNLAUNCHED else SEVERAL.get(name, 1),
        schema.is_mutable,
        torch.Tag.pointwise in function.tags or name in ("fill_", "masked_fill", "masked_fill_"),
    )


def _tensors(arguments: Sequence[Any]) -> list[Tensor]:
    """Those among an operation's arguments, themselves or in lists."""
    found = []
    for x in arguments:
        if isinstance(x, Tensor):
            found.append(x)
        elif isinstance(x, list | tuple):
            found += _tensors(x)
    return found


def _mapped(change: Callable[[Tensor], Tensor], x: Any) -> Any:
    """An argument or result with its tensors changed."""
    if isinstance(x, Tensor):
        return change(x)
    return type(x)(_mapped(change, y) for y in x) if isinstance(x, list | tuple) else x


def _held(x: Any) -> Any:
    """An argument with the values that tensors hold, in lists too."""
    if type(x) is Pretender:
        return x.held
    return type(x)(map(_held, x)) if isinstance(x, list | tuple) else x


def _copied(name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> str | None:
    """Between which devices an operation copies; None: it does not."""
    if name == "_to_copy":
        ends = isinstance(args[0], Pretender), torch.device(kwargs.get("device") or args[0].device).type == DEVICE.type
    elif name == "copy_":
        ends = isinstance(args[1], Pretender), isinstance(args[0], Pretender)
    else:
        return None
    return {(False, True): "to the device", (True, False): "to the host"}.get(ends)


def _waits(name: str, args: Sequence[Any], kwargs: dict[str, Any]) -> str | None:
    """What an operation of tensors of the device makes the host wait for; None: nothing."""
    if name in READS or name in CHECKS:
        return READS.get(name) or CHECKS[name]
    if kwargs.get("check_errors"):
        return f"{name} with its check of errors"
    if name in LU:
        return f"{name} of more than {LARGEST_LU} unknowns" if args[0].shape[-1] > LARGEST_LU else None
    if name == "linalg_qr" and "r" not in args:
        return "qr, whose factor Q is made world by world,"
    if name == "repeat_interleave" and kwargs.get("output_size") is None:
        return "repeat_interleave without the size"
    if name not in HARMLESS and ("linalg" in name or name in LINEAR_ALGEBRA):
        raise NotImplementedError(f"{name}: look up whether CUDA waits for it, and note it in {__name__}")
    return None


def _line() -> str:
    """The innermost line of the package that is being executed."""
    frame: FrameType | None = sys._getframe()
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith(PACKAGE + os.sep):
            return f"{os.path.relpath(code.co_filename, PACKAGE)}:{frame.f_lineno} {code.co_name}"
        frame = frame.f_back
    return "no line of pbfd_torch"
