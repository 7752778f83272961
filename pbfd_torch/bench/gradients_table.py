"""What `pbfd bench gradients` says of its rows: the cheapest way to an error, and all of them, as Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pbfd_torch.bench.gradients import DERIVATIVE
from pbfd_torch.bench.precision import OURS, PEER

Row = Mapping[str, Any]
LEVELS = (0.5, 0.1, 0.01, 0.001)  # relative errors to be reached
LEVEL_HEADERS = ("error ≤", "pbfd_torch, derivative", "pbfd_torch, differences", "MuJoCo, differences", "ours / MuJoCo")
_ROW_HEADERS = ("simulator", "method", "Δt [ms]", "gradient", "error", "its own differences", "forward [s]", "together [s]")
_REPORTED_HEADERS = ("reported", "gradient", "error", "forward [s]", "together [s]", "ratio")


def key(row: Row) -> tuple[str, str, str]:
    """Of one curve: simulator, scheme and method."""
    return row["simulator"], row["scheme"], row["method"]


def reached(rows: Sequence[Row], row: Row, level: float, uncertainty: float) -> bool:
    """Is the error known to be at most `level`, at this Δt and at every smaller one of the same curve? One that only passes
    through zero does not count. Neither does one of unsolved steps."""
    finer = [other for other in rows if key(other) == key(row) and other["dt"] <= row["dt"]]
    return uncertainty <= level and all(other["unsolved_steps"] == 0 and other["error"] <= level for other in finer)


def cheapest(problem: Mapping[str, Any], level: float, simulator: str, derivative: bool) -> Row | None:
    """The row with the least time for motion and gradient that reaches the level; None: none does."""
    found = problem["references"].get(simulator, {"relative": 0.0})
    rows = [row for row in problem["rows"] if row["simulator"] == simulator and (row["method"] == DERIVATIVE) == derivative]
    fit = [row for row in rows if reached(rows, row, level, found["relative"])]
    return min(fit, key=lambda row: float(row["together_s"]), default=None)


def level_table(problem: Mapping[str, Any]) -> list[list[str]]:
    """One line per level: the cheapest way of each column, and the time of our faster one over MuJoCo's."""
    lines = []
    for level in LEVELS:
        ways = [cheapest(problem, level, *which) for which in ((OURS, True), (OURS, False), (PEER, False))]
        ours = [way["together_s"] for way in ways[:2] if way is not None]
        ratio = "–" if not ours or ways[2] is None else f"{min(ours) / ways[2]['together_s']:.2g}"
        lines.append([f"{100 * level:g} %", *map(_way, ways), ratio])
    return lines


def _way(row: Row | None) -> str:
    return "–" if row is None else f"{_scheme(row)} {1e3 * row['dt']:.3g} ms: {1e3 * row['together_s']:.3g} ms"


def _scheme(row: Row) -> str:
    """The scheme, with how far inputs are moved where that is a choice."""
    return f"{row['scheme']} {row['method'].partition(' ')[2]}".strip()


def losses(problems: Mapping[str, Any]) -> list[str]:
    """Where MuJoCo's differences reach a level and ours do not, by neither method, or take longer; one line each."""
    found = []
    for problem in problems.values():
        for level in LEVELS:
            theirs = cheapest(problem, level, PEER, False)
            both = [cheapest(problem, level, OURS, derivative) for derivative in (True, False)]
            ours = min((way["together_s"] for way in both if way is not None), default=math.inf)
            if theirs is None or ours <= theirs["together_s"]:
                continue
            slower = "at no Δt measured" if ours == math.inf else f"{ours / theirs['together_s']:.2g} times as long"
            found.append(f"{problem['title']}: {100 * level:g} %: MuJoCo {_way(theirs)}, ours {slower}")
    return found


def markdown(report: Mapping[str, Any]) -> str:
    """The whole report."""
    about = report["environment"]
    peer = f"MuJoCo {about['mujoco']}" if about["mujoco"] else "no MuJoCo"
    parts = [
        "# Gradients: error against time",
        f"PyTorch {about['torch']}, {peer}, {about['processor']}, {about['threads']} thread, {about['dtype']}.",
        "\n".join(f"- {note}" for note in report["notes"]),
        "## Where ours loses",
        "\n".join(f"- {line}" for line in report["losses"]) or "- nowhere that was measured",
    ]
    for problem in report["problems"].values():
        parts += [f"## {problem['title']}", reference_text(problem), _table(LEVEL_HEADERS, level_table(problem))]
        parts += [_table(_ROW_HEADERS, [_cells(row, problem) for row in problem["rows"]])]
        parts += [f"Not measured here, {problem['reported_note']}.", _table(_REPORTED_HEADERS, _reported(problem))]
    return "\n\n".join(parts) + "\n"


def reference_text(problem: Mapping[str, Any]) -> str:
    """The right derivatives, and how well they are known."""
    if problem["exact"]:
        return f"Reference: {_gradient(problem['references'][OURS]['value'], problem['units'])}, exact."
    told = [
        f"{name} {_gradient(found['value'], problem['units'])} ± {found['uncertainty']:.1g} ({found['source']})"
        for name, found in problem["references"].items()
    ]
    return f"References: {'; '.join(told)}."


def _gradient(values: Sequence[float], units: Sequence[str]) -> str:
    return ", ".join(f"{value:.4g} {unit}" if math.isfinite(value) else "–" for value, unit in zip(values, units, strict=True))


def _cells(row: Row, problem: Mapping[str, Any]) -> list[str]:
    return [
        *(f"{row['simulator']} {row['scheme']}", row["method"], f"{1e3 * row['dt']:.3g}"),
        _gradient(row["gradient"], problem["units"]),
        f"{percent(row['error'])}{f', {unsolved} unsolved' if (unsolved := row['unsolved_steps']) else ''}",
        f"{row['own_differences']:.1e}" if math.isfinite(row["own_differences"]) else "",
        *map(_seconds, (row["forward_s"], row["together_s"])),
    ]


def _reported(problem: Mapping[str, Any]) -> list[list[str]]:
    return [
        [
            *(found["name"], _gradient(found["gradient"], problem["units"]), percent(found["error"])),
            *map(_seconds, (found["forward_s"], found["together_s"])),
            f"{found['ratio']:g}" if math.isfinite(found["ratio"]) else "",
        ]
        for found in problem["reported"]
    ]


def percent(error: float) -> str:
    """A relative error in a table."""
    return f"{100 * error:.2g} %" if error < 1 else f"{100 * error:.0f} %" if math.isfinite(error) else "–"


def _seconds(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else ""


def _table(headers: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rows = [headers, ["---"] * len(headers), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)
