"""`pbfd demo`: a chain drops onto a slope; rollout, summary and a picture."""

from __future__ import annotations

from pathlib import Path

from pbfd_torch.cli.options import Choices, load_setup, use_threads
from pbfd_torch.cli.outputs import check_file
from pbfd_torch.cli.picture import draw
from pbfd_torch.cli.simulate import print_summary, simulated


def run(folder: Path) -> int:
    """Writes `rollout.npz` and `picture.png` into `folder`; the exit status as of `pbfd simulate`."""
    target = folder / "rollout.npz"
    check_file("--out", target, ".npz")
    use_threads(1)
    choices = Choices()
    result = simulated(load_setup("chain-slope-drop", 64, choices), choices, dt=0.05)
    result.rollout.save(target)
    draw(result.setup, result.rollout, folder / "picture.png")
    print_summary(result, target)
    print(f"picture written to {folder / 'picture.png'}")
    return 0 if bool(result.rollout.solved.all()) else 1
