"""What the paper says of Fig. 6, what was measured, and which of it holds; and the measured rows as tables."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pbfd_torch.bench.figure_6 import COMMON_STEP, EAGER, GAIN_LIMIT, IN_TOUCH, OURS, SCENE, STARTS, TITLES, Row

PBFD, CONVENTIONAL = "implicit-euler", "conventional"  # the paper's integrator, and what it is compared with
LARGE_STEP, SAFE_STEP = 0.1, 0.001  # [s], the paper's
FLAT, RISING = 1.5, 2.0  # largest over smallest time: at most, at least
NOTES = (
    "time: wall ms per simulated second of one world; of a batch: its worlds are spread along the trajectory",
    f"unstable: NaN, or mechanical energy (the scheme's own) rises by over {GAIN_LIMIT:.0%} of the largest kinetic energy so far",
    "margin: how far the chain went beyond sliding downhill all the time; < 0: too much friction; > 0: right if links slip uphill",
    f"in touch: mean number of candidates no further than {1e3 * IN_TOUCH:g} mm from the ground",
    f"flat: largest time at most {FLAT:g} times the smallest; rising: at least {RISING:g} times",
    "times are compared of like with like: Newton–Euler's, which is in PyTorch, with ours in PyTorch; MuJoCo's with ours",
    "ours, Euler: implicit Euler; energy–mom.: the projected energy–momentum scheme",
    "MuJoCo: implicitfast or RK4, elliptic cones, impratio 100; contacts as stiff as it takes them, 2Δt; soft: its default, 0.02 s",
)


# Claims -------------------------------------------------------------------------------------------------------------------


def verdict(checks: Sequence[bool]) -> str:
    """In words, whether all, some or none of the checks pass."""
    if not checks:
        return "not measured"
    return "holds" if all(checks) else "holds in part" if any(checks) else "does not hold"


def claims(report: Mapping[str, Any]) -> list[dict[str, str]]:
    """`paper`: what it says, `measured`, and the `verdict`."""
    return [
        _limit(report, "Newton–Euler is stable only below Δt = 0.0025 s", [CONVENTIONAL]),
        _limit(
            report, "the same of MuJoCo, a Newton–Euler engine with soft contacts", [k for k in TITLES if k.startswith("mujoco")]
        ),
        _large_steps(report),
        _speedup(report, 3.0, COMMON_STEP),
        _speedup(report, 5.0, SAFE_STEP),
        _fastest(report, CONVENTIONAL),
        *(_fastest(report, key) for key in TITLES if key.startswith("mujoco") and key in report["best_dt"][SCENE]),
        _contacts(report, CONVENTIONAL, "time of Newton–Euler rises with the number of contacts", lambda x: x >= RISING),
        _contacts(report, PBFD, "time of PBFD is almost invariant to the number of contacts", lambda x: x <= FLAT),
        _friction(report),
        _fluctuation(report),
    ]


def _claim(paper: str, parts: Iterable[str], checks: Sequence[bool]) -> dict[str, str]:
    return {"paper": paper, "measured": "; ".join(parts) or "nothing", "verdict": verdict(checks)}


def _limit(report: Mapping[str, Any], paper: str, simulators: Sequence[str]) -> dict[str, str]:
    """Largest stable steps, which should not be above the paper's."""
    steps = report["time_steps"]
    parts, checks = [], []
    for key in simulators:
        found = [(start, best[key]) for start, best in report["best_dt"].items() if key in best]
        if found:
            smallest = min(row["dt"] for row in steps)
            words = [f"{start} {f'up to {dt:g} s' if dt else f'not even at {smallest:g} s'}" for start, dt in found]
            parts.append(f"{TITLES[key]}: {', '.join(words)}")
            checks += [(dt or 0.0) <= COMMON_STEP for _, dt in found]
    return _claim(paper, parts, checks)


def _large_steps(report: Mapping[str, Any]) -> dict[str, str]:
    rows = [row for row in report["time_steps"] if row["simulator"] in OURS and row["dt"] == LARGE_STEP]
    parts = [
        f"{TITLES[row['simulator']]}, {row['start']}: {'stable' if row['stable'] else 'unstable'}, energy gain "
        f"{row['energy_gain']:.1%}, {row['unsolved_steps']} of {row['steps']} steps unsolved"
        for row in rows
    ]
    checks = [row["stable"] and row["unsolved_steps"] == 0 for row in rows]
    return _claim(f"PBFD takes Δt = {LARGE_STEP:g} s", parts, checks)


def _speedup(report: Mapping[str, Any], factor: float, dt: float) -> dict[str, str]:
    """Newton–Euler at a step over implicit Euler at the large one, where both are stable."""
    rows = {(row["simulator"], row["start"], row["dt"]): row["ms_per_s"] for row in report["time_steps"] if row["stable"]}
    parts, ratios = [], []
    for start in report["best_dt"]:
        ours, theirs = rows.get((_like(report), start, LARGE_STEP), {}), rows.get((CONVENTIONAL, start, dt), {})
        found = {worlds: theirs[worlds] / ours[worlds] for worlds in ours if worlds in theirs}
        ratios += list(found.values())
        if found:
            parts.append(f"{start} " + ", ".join(f"{_times(ratio)} ({_batch(worlds)})" for worlds, ratio in found.items()))
    paper = f"PBFD at {LARGE_STEP:g} s is {factor:g} times faster than Newton–Euler at {dt:g} s"
    return _claim(paper, parts, [ratio >= factor for ratio in ratios])


def _fastest(report: Mapping[str, Any], simulator: str) -> dict[str, str]:
    """Implicit Euler against another, each at the stable step that takes it the least time."""
    parts, checks = [], []
    ours = _like(report) if simulator == CONVENTIONAL else PBFD
    for start in report["best_dt"]:
        for worlds in ("1", str(report["worlds"])):
            (own, dt), (their, step) = (_least(report, key, start, worlds) for key in (ours, simulator))
            if math.isfinite(own + their):
                checks.append(their > own)
                parts.append(f"{start} {_times(their / own)}, {dt:g} s against {step:g} s ({_batch(worlds)})")
            elif math.isfinite(own) and worlds == "1":
                parts.append(f"{start}: the other is stable nowhere")
    return _claim(f"PBFD is faster than {TITLES[simulator]}, each at its fastest stable Δt", parts, checks)


def _like(report: Mapping[str, Any]) -> str:
    """Implicit Euler as Newton–Euler is stepped, in PyTorch."""
    return EAGER if EAGER in report["best_dt"][SCENE] else PBFD


def _least(report: Mapping[str, Any], simulator: str, start: str, worlds: str) -> tuple[float, float]:
    """The shortest time of a simulator's stable steps, up to the largest that is stable with all smaller ones, and that step."""
    most = report["best_dt"][start].get(simulator) or 0.0
    rows = [row for row in report["time_steps"] if (row["simulator"], row["start"]) == (simulator, start) and row["dt"] <= most]
    return min(((row["ms_per_s"][worlds], row["dt"]) for row in rows if worlds in row["ms_per_s"]), default=(math.inf, math.nan))


def _times(ratio: float) -> str:
    return f"{ratio:.0f}x" if ratio >= 10 else f"{ratio:.2g}x"


def _batch(worlds: str) -> str:
    return "1 world" if worlds == "1" else f"{worlds} worlds"


def _contacts(report: Mapping[str, Any], simulator: str, paper: str, passes: Callable[[float], bool]) -> dict[str, str]:
    """Time with the most contacts over that with the fewest, and its extremes where they lie between."""
    parts, ratios = [], []
    own = [row for row in report["contacts"] if row["simulator"] == simulator]
    for dt in sorted({row["dt"] for row in own}):
        rows = sorted((row for row in own if row["dt"] == dt), key=lambda row: row["points"])
        for worlds in rows[0]["ms_per_s"]:
            times = [row["ms_per_s"].get(worlds, math.nan) for row in rows]
            ratios.append(times[-1] / times[0])
            parts.append(
                f"{_times(ratios[-1])} from {rows[0]['in_touch']:.0f} to {rows[-1]['in_touch']:.0f} at {dt:g} s ({_batch(worlds)})"
            )
    return _claim(paper, parts, [passes(ratio) for ratio in ratios])


def _series(report: Mapping[str, Any]) -> dict[str, list[float]]:
    """Times of panel (d), named."""
    found: dict[str, list[float]] = {}
    for row in report["friction"]:
        name = TITLES[row["simulator"]] + ("" if row["law"] == "Coulomb" else f" with {row['law']}'s law")
        found.setdefault(name, []).append(row["ms_per_s"].get("1", math.nan))
    return found


def _friction(report: Mapping[str, Any]) -> dict[str, str]:
    ratios = {name: max(times) / min(times) for name, times in _series(report).items() if not name.startswith("MuJoCo")}
    parts = [f"{name}: the slowest {_times(ratio)} the fastest" for name, ratio in ratios.items()]
    return _claim("time of both is almost invariant to friction", parts, [ratio <= FLAT for ratio in ratios.values()])


def _fluctuation(report: Mapping[str, Any]) -> dict[str, str]:
    spread = {name: statistics.stdev(times) / statistics.fmean(times) for name, times in _series(report).items() if len(times) > 1}
    named = {key: spread[TITLES[key]] for key in (CONVENTIONAL, PBFD) if TITLES[key] in spread}
    parts = [f"{TITLES[key]}: standard deviation {value:.0%} of the mean" for key, value in named.items()]
    checks = [named[CONVENTIONAL] > named[PBFD]] if len(named) == 2 else []
    return _claim("Newton–Euler's time fluctuates more with friction", parts, checks)


# Tables -------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sheet:
    title: str
    headers: Sequence[str]
    lines: Sequence[Sequence[str]]


_COST = ("time, 1 world", "time, batch")
_STATE = ("stable?", "energy gain")


def sheets(report: Mapping[str, Any]) -> list[Sheet]:
    """The panels as text."""
    duration = report["duration_s"]
    found = []
    for start in report["best_dt"]:
        rows = [row for row in report["time_steps"] if row["start"] == start]
        found.append(
            Sheet(
                f"(b) {STARTS[start].title}: {duration:g} s",
                ("simulator", "Δt [s]", "run [s]", *_COST, *_STATE, "margin [m]", "depth [mm]", "unsolved"),
                [
                    (_name(row), f"{row['dt']:g}", f"{row['simulated_s']:.3g}", *_cost(row), *_state(row), *_error(row))
                    for row in rows
                ],
            )
        )
    found.append(
        Sheet(
            f"(c) {STARTS[SCENE].title}: contacts",
            ("simulator", "Δt [s]", "points a link", "in touch", *_COST, *_STATE),
            [
                (_name(row), f"{row['dt']:g}", f"{row['points']}", _text(row["in_touch"], ".1f"), *_cost(row), *_state(row))
                for row in report["contacts"]
            ],
        )
    )
    found.append(
        Sheet(
            f"(d) {STARTS[SCENE].title}: friction",
            ("simulator", "law", "Δt [s]", "μ", "time, 1 world", *_STATE, "margin [m]", "speed at the end [m/s]"),
            [
                (_name(row), row["law"], f"{row['dt']:g}", f"{row['mu']:g}", _cost(row)[0], *_state(row), *_sliding(row))
                for row in report["friction"]
            ],
        )
    )
    return found


def _text(value: float | None, form: str) -> str:
    return "–" if value is None or not math.isfinite(value) else format(value, form)


def _time(value: float | None) -> str:
    return _text(value, ".3g" if value is None or value < 100 else ".0f")


def _meters(value: float | None) -> str:
    """To 0.1 mm; nothing where the motion has blown up."""
    return _text(value if value is not None and abs(value) < 1e6 else None, ".4f")


def _name(row: Row) -> str:
    return TITLES[row["simulator"]]


def _cost(row: Row) -> tuple[str, str]:
    times = row["ms_per_s"]
    batch = next((time for worlds, time in times.items() if worlds != "1"), None)
    return _time(times.get("1")), _time(batch)


def _state(row: Row) -> tuple[str, str]:
    return "yes" if row["stable"] else "no" if row["finite"] else "NaN", _text(row["energy_gain"], ".1%")


def _error(row: Row) -> tuple[str, str, str]:
    return _meters(row["margin_m"]), _text(row["penetration_mm"], ".3g"), f"{row['unsolved_steps']}/{row['steps']}"


def _sliding(row: Row) -> tuple[str, str]:
    slides = row["law"] == "Coulomb" and row["mu"] < math.tan(math.radians(30))
    return _meters(row["margin_m"] if slides else None), _text(row["speed_m_s"], ".3g")


def markdown(report: Mapping[str, Any]) -> str:
    """The claims, the panels and the notes."""
    verdicts = Sheet(
        "Claims", ("the paper", "measured", "verdict"), [(x["paper"], x["measured"], x["verdict"]) for x in report["claims"]]
    )
    parts = [f"# Fig. 6: a chain of ten links slides off a slope, {report['duration_s']:g} s"]
    for sheet in (verdicts, *sheets(report)):
        rule = "|".join(["---"] * len(sheet.headers))
        lines = "\n".join(f"| {' | '.join(line)} |" for line in sheet.lines)
        parts.append(f"## {sheet.title}\n\n| {' | '.join(sheet.headers)} |\n|{rule}|\n{lines}")
    parts.append("\n".join(f"- {note}" for note in report["notes"]))
    return "\n\n".join(parts) + "\n"
