"""Benchmarks by both engines: the same verdicts, and each says which engine made it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pbfd_torch.bench import engines, figure_5, figure_6, hard_cases
from pbfd_torch.cli import (
    bench_friction,
    bench_gradients,
    bench_hard_cases,
    bench_precision,
    bench_slope,
    bench_soak,
    bench_solvers,
)
from pbfd_torch.errors import InputError
from pbfd_torch.native.engine import Engine, Native, Torch
from pbfd_torch.native.library import library
from tests.printed import called

MODULES = {
    "solvers": bench_solvers,
    "friction": bench_friction,
    "precision": bench_precision,
    "gradients": bench_gradients,
    "slope": bench_slope,
    "soak": bench_soak,
    "hard-cases": bench_hard_cases,
}
needs_core = pytest.mark.skipif(library() is None, reason="there is no compiled core")


def silent(done: int) -> None:
    """Progress that nobody watches."""


def same(verdicts: Callable[[Engine | None], Any]) -> Any:
    """What is said alike where nothing is asked for, and of PyTorch."""
    found = verdicts(None)
    assert found == verdicts(Torch())
    return found


@needs_core
@pytest.mark.parametrize("name", ["free-fall", "straight-path", "inelastic-drop"])
def test_hard_cases(name: str) -> None:
    """Every check at the larger quick step: free motion, friction, and impact."""
    schemes = ("implicit-euler", "energy-momentum")

    def verdicts(engine: Engine | None) -> list[tuple[str, str, str]]:
        found = []
        for case, run in hard_cases.plan([name], schemes, (max(hard_cases.CASES[name].brief),), True, engine):
            result = hard_cases.measure(case, run)
            assert result.engine == ("torch" if engine else "native")
            found += [(run.integrator, check.name, check.verdict) for check in result.checks]
        return found

    assert "fail" not in {verdict for _, _, verdict in same(verdicts)}


@needs_core
def test_figure_5(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether the distance falls throughout, where it is shortest, and which boxes still move; distances to .1 mm. The minimum of E
    is found in PyTorch, whatever was asked for."""
    monkeypatch.setattr(figure_5, "DURATION", 0.5)
    distances = []

    def verdicts(engine: Engine | None) -> list[Any]:
        curves = {key: figure_5.measure_case(case, 0.05, 5, silent, engine) for key, case in figure_5.CASES.items()}
        made = dict.fromkeys(curves, "torch" if engine else "native") | {"pbd-energy": "torch"}
        assert {key: x["engine"] for key, x in curves.items()} == made
        distances.append([x for curve in curves.values() for x in curve["distance_m"]])
        return [(key, x["falls"], x["least_at"], x["moving"], x["unsolved_steps"]) for key, x in curves.items()]

    assert [falls for _, falls, *_ in same(verdicts)] == [True, False, False, True, True]
    assert distances[0] == pytest.approx(distances[1], abs=1e-4)


@needs_core
@pytest.mark.parametrize("simulator", ["implicit-euler", "energy-momentum"])
def test_figure_6(simulator: str) -> None:
    """Stable at large steps, all solved, from a drop and under the PBFD law as well; Newton–Euler is PyTorch's with both."""
    cases = [figure_6.Case("dropped", 0.05, 6), figure_6.Case("laid", 0.1, 2, points=4, law="PBFD")]

    def verdicts(engine: Engine | None) -> list[Any]:
        rows = [figure_6.measure_run(simulator, case, engine=engine) for case in cases]
        assert {row["engine"] for row in rows} == {"torch" if engine else "native"}
        return [(row["finite"], row["stable"], row["unsolved_steps"], round(row["margin_m"], 5)) for row in rows]

    assert [x[:3] for x in same(verdicts)] == [(True, True, 0)] * 2
    for eager in ("conventional", figure_6.EAGER):
        assert figure_6.measure_run(eager, figure_6.Case("laid", 0.01, 1), engine=Native())["engine"] == "torch"


@pytest.mark.parametrize("name", MODULES)
def test_the_users_engine(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """`--engine` goes down as the engine itself; without it there is none."""
    asked: list[Engine | None] = []

    def kept(*arguments: Any) -> Any:
        runs = arguments[0]
        asked.append(runs[0][1].engine if name == "hard-cases" else arguments[-1])
        raise InputError("enough")

    monkeypatch.setattr(MODULES[name], "measured", kept)
    for given in ((), ("--engine", "native"), ("--engine", "torch")):
        assert called(monkeypatch, "bench", name, "--out", tmp_path, *given) == 2
    assert asked == [None, Native(), Torch()]


def test_in_words() -> None:
    """The engine of most, and what others made, each once."""
    assert engines.in_words([("a", "native"), ("b", "native")]) == "engine: native"
    made = [("a", "native"), ("b", "torch"), ("a", "native"), ("b", "torch"), ("c", "native"), ("d", "mujoco"), ("e", "torch")]
    assert engines.in_words([*made, ("f", "native")]) == "engine: native; of b, e: torch; of d: mujoco"
