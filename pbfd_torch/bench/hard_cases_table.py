"""The hard cases on one page: a row for every case, a cell for every integrator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from typing import Any

from pbfd_torch.bench.hard_cases import CASES, Result
from pbfd_torch.bench.hard_cases_case import Check

LETTERS = {"warm_started": "w", "continued": "c", "eased": "e", "halved": "h"}


def table(results: Sequence[Result], integrators: Sequence[str], cell: Callable[[Sequence[Result]], str]) -> list[list[str]]:
    """Rows of cells: the case, and what every integrator made of it over all its steps; "–" where it has no run."""
    rows = []
    for name, group in groupby(results, lambda result: result.case):
        of_case = list(group)
        found = ([result for result in of_case if result.integrator == x] for x in integrators)
        rows.append([name, *(cell(of_integrator) if of_integrator else "–" for of_integrator in found)])
    return rows


def short(results: Sequence[Result]) -> str:
    """Verdict and the steps of what fails or only is reported; value/limit of the number nearest to its limit, or furthest beyond;
    unsolved steps and fallbacks."""
    check = _telling(results)
    return " ".join(part for part in (verdict(results), f"{check.value:.2g}/{check.limit:.2g}", effort(results)) if part)


def long(results: Sequence[Result]) -> str:
    """The same with the number's name, in lines."""
    check = _telling(results)
    number = f"{check.name}: {check.value:.2g} {'≤' if check.holds else '>'} {check.limit:.2g}"
    return "<br>".join(part for part in (verdict(results), number, effort(results)) if part)


def verdict(results: Sequence[Result]) -> str:
    """FAIL and the steps that fail; pass, with the steps at which something that need not hold does not."""
    checks = [(result.dt, check) for result in results for check in result.checks]
    failed = [dt for dt, check in checks if check.fails]
    over = [dt for dt, check in checks if not check.holds]
    return f"FAIL {_steps(failed)}" if failed else f"pass ({_steps(over)} over)" if over else "pass"


def _telling(results: Sequence[Result]) -> Check:
    """The number that says most: of those that fail, else of those beyond their limits, else of all that must hold."""
    checks = [check for result in results for check in result.checks]
    groups = (
        [check for check in checks if check.fails],
        [check for check in checks if not check.holds],
        [check for check in checks if check.must],
        checks,
    )
    return max(next(group for group in groups if group), key=lambda check: check.strain)


def _steps(steps: Sequence[float]) -> str:
    return " ".join(f"{dt:g}".removeprefix("0") for dt in sorted(set(steps)))


def effort(results: Sequence[Result]) -> str:
    """Unsolved steps and fallbacks, such as "3 unsolved, e 12"; empty for none."""
    counts = {letter: sum(result.fallbacks[kind] for result in results) for kind, letter in LETTERS.items()}
    unsolved = sum(result.unsolved for result in results)
    parts = [f"{unsolved} unsolved"] if unsolved else []
    return ", ".join(parts + [f"{letter} {count}" for letter, count in counts.items() if count])


def markdown(report: Mapping[str, Any], results: Sequence[Result]) -> str:
    """The page, and every number on it."""
    about = report["environment"]
    integrators = report["integrators"]
    lines = [
        "# Hard cases",
        "",
        f"PyTorch {about['torch']}, {about['threads']} thread, {about['dtype']}, {about['processor']}; {report['wall_s']:.0f} s.",
        f"{len(results)} runs, {report['failed']} failed.",
        "",
        *_rows([["case", *integrators], *table(results, integrators, long)]),
        "",
        *(f"- {note}" for note in report["notes"]),
        "",
        "## The laws",
        "",
        *(f"- **{name}**: {CASES[name].law}" for name, _ in groupby(results, lambda result: result.case)),
        "",
        "## Every number",
        "",
        *_rows([["case", "integrator", "Δt [s]", "number", "value", "limit", "verdict"], *_numbers(results)]),
        "",
    ]
    return "\n".join(lines)


def _numbers(results: Sequence[Result]) -> list[list[str]]:
    return [
        [result.case, result.integrator, f"{result.dt:g}", check.name, f"{check.value:.3g}", f"{check.limit:.3g}", check.verdict]
        for result in results
        for check in result.checks
    ]


def _rows(cells: Sequence[Sequence[str]]) -> list[str]:
    """A table of Markdown; the first row is its head."""
    lines = ["| " + " | ".join(x.replace("|", "\\|") for x in line) + " |" for line in cells]
    return [lines[0], "|" + "---|" * len(cells[0]), *lines[1:]]
