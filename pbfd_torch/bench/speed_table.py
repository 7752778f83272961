"""What `pbfd bench speed` says of its rows: how many times as fast, and everything as Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pbfd_torch.bench.speed_mujoco import INTEGRATORS

Row = Mapping[str, Any]
PEERS = tuple(INTEGRATORS)


def finite(value: float | None) -> bool:
    """Whether there is a number."""
    return value is not None and math.isfinite(value)


def ratios(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Of every batch that was timed in the core: how many times as many control steps a second as the others make of the same
    batch with as many threads (torch in the same dtype, MuJoCo in double), and which of MuJoCo's is the fastest."""
    timed = [row for row in rows if finite(row["control_steps_per_s"])]
    found = []
    for row in (row for row in timed if row["engine"] == "native"):
        same = [x for x in timed if all(x[key] == row[key] for key in ("scene", "worlds", "threads"))]
        others = {x["engine"]: x for x in same if x["engine"] in PEERS or (x["engine"], x["dtype"]) == ("torch", row["dtype"])}
        best = min((others[name] for name in PEERS if name in others), key=lambda x: float(x["us_per_step"]), default=None)
        found.append({
            **{key: row[key] for key in ("scene", "worlds", "threads", "dtype", "ms_per_simulated_s")},
            "times_as_fast_as": {name: row["control_steps_per_s"] / x["control_steps_per_s"] for name, x in others.items()},
            "fastest_mujoco": None if best is None else best["engine"],
            "fastest_mujoco_ms_per_simulated_s": None if best is None else best["ms_per_simulated_s"],
        })  # fmt: skip
    return found


RATIO_HEADERS = ("scene", "worlds", "dtype", *(f"/ {name}" for name in (*PEERS, "torch")), "ms/s", "MuJoCo's best ms/s")


def ratio_lines(found: Sequence[Row], threads: int = 1) -> list[list[str]]:
    """One line for each batch with so many threads."""
    return [
        [
            *(row["scene"], str(row["worlds"]), row["dtype"]),
            *(_number(row["times_as_fast_as"].get(name)) for name in (*PEERS, "torch")),
            _number(row["ms_per_simulated_s"]),
            " ".join((_number(row["fastest_mujoco_ms_per_simulated_s"]), row["fastest_mujoco"] or "")).strip(),
        ]
        for row in found
        if row["threads"] == threads
    ]


Batch = tuple[int, int]
"""Worlds and threads."""


def batches(rows: Sequence[Row]) -> list[Batch]:
    """What all scenes were timed in: numbers of worlds with one thread, and the largest of them with more."""
    scenes = dict.fromkeys(row["scene"] for row in rows)
    worlds = sorted(set.intersection(*({row["worlds"] for row in rows if row["scene"] == name} for name in scenes)))
    threads = sorted({row["threads"] for row in rows})
    return [(count, 1) for count in worlds] + [(worlds[-1], count) for count in threads if count > 1]


def contestant_headers(shown: Sequence[Batch]) -> list[str]:
    """Of `contestant_lines`."""
    rates = (f"{worlds} w., {threads} thr." if threads > 1 else f"{worlds} w." for worlds, threads in shown)
    return ["engine", "dtype", "steps", *rates, "µs", "evaluations", "solved", "fallbacks", "error [m]", "warm-up [s]"]


def contestant_lines(rows: Sequence[Row], shown: Sequence[Batch]) -> list[list[str]]:
    """One line for each contestant of a scene: thousands of control steps a second in each batch, and the rest of the largest one
    that it was timed in with one thread."""
    lines = []
    for engine, dtype in dict.fromkeys((row["engine"], row["dtype"]) for row in rows):
        mine = {(row["worlds"], row["threads"]): row for row in rows if (row["engine"], row["dtype"]) == (engine, dtype)}
        alone = [row for row in mine.values() if row["threads"] == 1]
        last = max(alone, key=lambda row: (finite(row["control_steps_per_s"]), row["worlds"]))
        lines.append([
            *(engine, dtype, str(last["substeps"])),
            *(_number(mine[batch]["control_steps_per_s"] / 1e3) for batch in shown),
            *(_number(last[key]) for key in ("us_per_step", "evaluations_mean", "solved_share", "fallback_share")),
            *(_number(last[key], 2) for key in ("error_m", "warmup_s")),
        ])  # fmt: skip
    return lines


def remarks(rows: Sequence[Row]) -> list[str]:
    """What there is to say of single rows, once each."""
    return list(dict.fromkeys(f"{row['engine']} {row['dtype']}: {row['note']}" for row in rows if row["note"]))


def _number(value: float | None, digits: int = 3) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"


_COLUMNS = (
    *("engine", "dtype", "worlds", "threads", "substeps", "control_steps_per_s", "physics_steps_per_s", "us_per_step"),
    *("evaluations_mean", "solved_share", "fallback_share", "error_m", "warmup_s", "timed_world_steps", "note"),
)


def markdown(report: Mapping[str, Any]) -> str:
    """The whole report: ratios, an overview, notes, every row."""
    about, rows = report["environment"], report["rows"]
    peer = f"MuJoCo {about['mujoco']}" if about["mujoco"] else "no MuJoCo"
    of = {name: [row for row in rows if row["scene"] == name] for name in report["scenes"]}
    shown = batches(rows)
    overview = [[name, *line] for name, mine in of.items() for line in contestant_lines(mine, shown)]
    parts = [
        "# Speed",
        f"PyTorch {about['torch']}, {peer}, native core {about['native'] or 'missing'}, {about['processor']}.",
        "## How many times as fast the core is, one thread",
        _table(RATIO_HEADERS, ratio_lines(report["ratios"])),
        "## Thousands of control steps a second",
        _table(["scene", *contestant_headers(shown)], overview),
        "\n".join(f"- {note}" for note in report["notes"]),
    ]
    for name, scene in report["scenes"].items():
        parts += [f"## {name}", heading(name, scene) + "."]
        parts.append(_table(_COLUMNS, [[_cell(row[key]) for key in _COLUMNS] for row in of[name]]))
    return "\n\n".join(parts) + "\n"


def heading(name: str, scene: Mapping[str, Any]) -> str:
    """What a scene is, in a line."""
    own = ", ".join(f"{simulator} at {x['source']} ± {x['uncertainty_m']:.1g} m" for simulator, x in scene["references"].items())
    told = f"; references: {own}" if own else ""
    return f"{name}: control steps of {scene['dt_s']:g} s, {scene['steps']} a rollout; error of {scene['error_of']}{told}"


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "–" if math.isnan(value) else f"{value:.4g}"
    return str(value)


def _table(headers: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rows = [headers, ["---"] * len(headers), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)
