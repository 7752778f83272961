"""`pbfd optimize`: what it prints, writes and returns."""

from __future__ import annotations

from pathlib import Path

import pytest

from pbfd_torch.optimize.tasks import box_throw
from pbfd_torch.records.rollout import Rollout
from tests.printed import Printed, called

KEYS = {
    *("task", "criterion", "worlds", "reached", "iterations", "wall_s", "cost_before_median", "cost_after_median"),
    *("worlds_not_reached", "unsolved_steps", "doubtful_steps"),
}


def optimize(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: object) -> Printed:
    capsys.readouterr()
    status = called(monkeypatch, "optimize", *arguments)
    printed = capsys.readouterr()
    return Printed(status, printed.out, printed.err)


def test_a_short_run_writes_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """One iteration on one world does not reach the goal: status 1; rollouts before and after, and the curve, are written."""
    folder = tmp_path / "new" / "folder"
    ran = optimize(monkeypatch, capsys, "hopper", "--worlds", 1, "--iterations", 1, "--out", folder, "--json")
    assert (ran.status, ran.err) == (1, "")
    assert set(ran.data) == KEYS
    assert (ran.data["task"], ran.data["worlds"], ran.data["iterations"]) == ("hopper", 1, 1)
    assert (ran.data["reached"], ran.data["worlds_not_reached"], ran.data["unsolved_steps"]) == (0, [0], 0)
    assert ran.data["cost_after_median"] < ran.data["cost_before_median"]
    before, after = (Rollout.load(folder / name) for name in ("before.npz", "after.npz"))
    assert bool((before.q[0] == after.q[0]).all())
    assert not bool((before.q[-1] == after.q[-1]).all())
    assert (folder / "cost.png").read_bytes().startswith(b"\x89PNG")


def test_a_reached_goal_is_status_0(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Here one within 10 m. Without --json there is a table, and nothing on standard error where that is no terminal."""
    monkeypatch.setattr(box_throw, "NEAR", 10.0)
    ran = optimize(monkeypatch, capsys, "box-throw", "--worlds", 1, "--iterations", 1)
    assert (ran.status, ran.err) == (0, "")
    assert ran.out.startswith("pbfd optimize box-throw")
    for key in KEYS - {"task"}:
        assert key in ran.out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("fly",), "no task named 'fly': the tasks are box-throw, arm-swing-up, hopper"),
        (("hopper", "--worlds", 0), "--worlds is 0: must be from 1 to"),
        (("hopper", "--iterations", 0), "--iterations is 0: must be from 1 to 1000000"),
        (("hopper", "--out", "/dev/null/x"), "--out is '/dev/null/x': must be a folder"),
    ],
)
def test_bad_input_is_status_2(
    arguments: tuple[object, ...], words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ran = optimize(monkeypatch, capsys, *arguments)
    assert ran.status == 2
    assert words in ran.err
    assert ran.out == ""
