"""What the `pbfd bench` commands share: checks, the environment they measured in, plain JSON values, and tables."""

from __future__ import annotations

import importlib.metadata
import json
import math
import platform
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from pbfd_torch.errors import InputError
from pbfd_torch.files import write_whole


def chosen(option: str, text: str, valid: Iterable[str], read: Callable[[str], str] = str.strip, what: str = "") -> list[str]:
    """The values in a list separated by commas, in the order of the valid ones; all of them where it is empty. `what` they are is
    said in the message. Raises `InputError`."""
    given = [read(part) for part in text.split(",") if part.strip()]
    known = list(valid)
    if not set(given) <= set(known) or (text and not given):
        raise InputError(f"{option} is '{text}': must be {what}from {', '.join(known)}, separated by commas")
    return [name for name in known if not given or name in given]


def write_files(folder: Path, report: dict[str, Any], name: str, *others: Callable[[], object]) -> None:
    """The report as JSON under that name, and whatever else the `others` write. Raises `InputError` where that cannot be done."""
    try:
        write_whole(folder / name, json.dumps(plain(report), indent=1, allow_nan=False) + "\n")
        for write in others:
            write()
    except OSError as error:
        raise InputError(f"cannot write to '{folder}': {error.strerror or error}") from error


def environment() -> dict[str, Any]:
    """What the numbers were measured with."""
    return {
        "pbfd_torch": _version(),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "threads": torch.get_num_threads(),
        "dtype": "float64",
        "device": "cpu",
    }


def _version() -> str | None:
    """The installed version; None in a checkout that is not installed."""
    try:
        return importlib.metadata.version("pbfd_torch")
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    """The CPU's name, where the system tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def plain(value: Any) -> Any:
    """The same with None for NaN and infinity, which JSON lacks."""
    if isinstance(value, dict):
        return {key: plain(x) for key, x in value.items()}
    if isinstance(value, list):
        return [plain(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def new_table(title: str, *headers: str) -> Table:
    """An empty table in the style of the benchmarks."""
    result = Table(title=title, title_justify="left", header_style="bold cyan", padding=(0, 1, 0, 0), box=None)
    for k, header in enumerate(headers):
        result.add_column(header, justify="right" if k else "left", overflow="fold")
    return result


def three_digits(value: float) -> str:
    """A positive number in a table."""
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"
