"""Which is the cheapest way to an error: what `pbfd bench precision` says of its rows, as plain data and as Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pbfd_torch.bench.precision import OURS, PEER

Row = Mapping[str, Any]
MOST_GAIN = 0.1  # of the largest kinetic energy: a motion that gains more is wrong, however small its error


def reached(row: Row, level: float, uncertainty: float) -> bool:
    """Is the error of this row known to be at most `level`?"""
    fine = not row["diverged"] and row["unsolved_steps"] == 0 and row.get("energy_gain", 0.0) <= MOST_GAIN
    return fine and uncertainty <= level and bool(row["error"] <= level)


def cheapest(rows: Sequence[Row], level: float, worlds: str, uncertainty: float = 0.0) -> Row | None:
    """The row with the least time in a batch of `worlds` among those that reach the level; None: none does."""
    found = [row for row in rows if worlds in row["ms_per_s"] and reached(row, level, uncertainty)]
    return min(found, key=lambda row: float(row["ms_per_s"][worlds]), default=None)


def batch_of(scene: Mapping[str, Any]) -> str:
    """The larger batch that ours was timed in."""
    return str(max((int(worlds) for row in scene["rows"] for worlds in row["ms_per_s"]), default=1))


def columns(scene: Mapping[str, Any]) -> list[tuple[str, str, list[Row], float]]:
    """What is compared: title, batch, rows, and the uncertainty of their reference."""
    own = scene["own_references"]
    rows = {name: [row for row in scene["rows"] if row["simulator"] == name] for name in (OURS, PEER)}
    unsure = {name: own.get(name, {"uncertainty": 0.0})["uncertainty"] for name in (OURS, PEER)}
    batch = batch_of(scene)
    return [
        (f"{OURS}, {batch} worlds", batch, rows[OURS], unsure[OURS]),
        (f"{OURS}, 1 world", "1", rows[OURS], unsure[OURS]),
        (PEER, "1", rows[PEER], unsure[PEER]),
    ]


def level_table(scene: Mapping[str, Any]) -> list[list[str]]:
    """One line per level: the level, the cheapest way of each column, and the time of our batch over MuJoCo's."""
    lines = []
    for level in scene["levels"]:
        ways = [(cheapest(rows, level, worlds, unsure), worlds) for _, worlds, rows, unsure in columns(scene)]
        ours, theirs = (None if way is None else way["ms_per_s"][worlds] for way, worlds in (ways[0], ways[2]))
        ratio = "–" if ours is None or theirs is None else f"{ours / theirs:.2g}"
        lines.append([f"{level:g} {scene['unit']}", *(_way(way, worlds) for way, worlds in ways), ratio])
    return lines


def _way(row: Row | None, worlds: str) -> str:
    return "–" if row is None else f"{row['integrator']} {row['dt']:.3g} s: {row['ms_per_s'][worlds]:.3g}"


def losses(scenes: Mapping[str, Any]) -> list[str]:
    """Where MuJoCo reaches a level and ours, in its batch, does not, or takes longer; one line each."""
    found = []
    for scene in scenes.values():
        (_, batch, rows, unsure), _, (_, _, peers, peers_unsure) = columns(scene)
        for level in scene["levels"]:
            theirs = cheapest(peers, level, "1", peers_unsure)
            ours = cheapest(rows, level, batch, unsure)
            if theirs is None:
                continue
            where, cost = f"{scene['title']}: {level:g} {scene['unit']}", theirs["ms_per_s"]["1"]
            if ours is None:
                found.append(f"{where}: MuJoCo {theirs['integrator']} {cost:.3g} ms, ours at no time step measured")
            elif ours["ms_per_s"][batch] > cost:
                slower = ours["ms_per_s"][batch] / cost
                found.append(f"{where}: ours takes {slower:.2g} times as long as MuJoCo {theirs['integrator']}")
    return found


LEVEL_HEADERS = ("error ≤", "pbfd_torch, batch", "pbfd_torch, 1 world", "MuJoCo", "batch / MuJoCo")
_ROW_HEADERS = ("simulator", "integrator", "Δt [s]", "error", "unsolved", "fallbacks", "ms/s, 1 world", "ms/s, batch", "also")


def markdown(report: Mapping[str, Any]) -> str:
    """The whole report."""
    about = report["environment"]
    peer = f"MuJoCo {about['mujoco']}" if about["mujoco"] else "no MuJoCo"
    parts = [
        "# Work–precision",
        f"PyTorch {about['torch']}, {peer}, {about['processor']}, {about['threads']} thread, {about['dtype']}.",
        "Wall milliseconds per simulated second and world. Batch: " + f"{report['worlds']} worlds.",
        "\n".join(f"- {note}" for note in report["notes"]),
        "## Where ours loses",
        "\n".join(f"- {line}" for line in report["losses"]) or "- nowhere that was measured",
    ]
    for name, scene in report["scenes"].items():
        parts += [f"## {scene['title']} (`{name}`)", f"Reference: {scene['reference']}.{_own_text(scene)}"]
        parts += [_table(LEVEL_HEADERS, level_table(scene)), _table(_ROW_HEADERS, [_cells(row, scene) for row in scene["rows"]])]
    return "\n\n".join(parts) + "\n"


def _own_text(scene: Mapping[str, Any]) -> str:
    found = scene["own_references"].items()
    return "".join(f" {name}: {own['source']}, ± {own['uncertainty']:.2g} {scene['unit']}." for name, own in found)


def _cells(row: Row, scene: Mapping[str, Any]) -> list[str]:
    batch = batch_of(scene)
    known = {
        *("simulator", "engine", "integrator", "dt", "error", "diverged"),
        *("world_steps", "unsolved_steps", "fallbacks", "ms_per_s"),
    }
    also = ", ".join(f"{name} {value:.2g}" for name, value in row.items() if name not in known and math.isfinite(value))
    ours = row["simulator"] == OURS
    times = row["ms_per_s"]
    return [
        *(row["simulator"], row["integrator"], f"{row['dt']:.3g}"),
        "diverged" if row["diverged"] else f"{row['error']:.3g} {scene['unit']}",
        f"{row['unsolved_steps']}/{row['world_steps']}" if ours else "",
        "/".join(map(str, row["fallbacks"].values())) if ours else "",
        "" if row["diverged"] else f"{times['1']:.3g}",
        f"{times[batch]:.3g}" if batch in times else "",
        also,
    ]


def _table(headers: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rows = [headers, ["---"] * len(headers), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)
