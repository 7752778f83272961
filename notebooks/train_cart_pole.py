# %% [markdown]
# # A controller trained here, tried elsewhere
#
# PPO learns to balance a pole on a cart in 16 worlds at once. The same policy, its weights untouched, is then tried on the
# conventional Newton–Euler stepper and on MuJoCo. Longer trainings: `pbfd train hopper --out runs/hopper`, and
# `pbfd evaluate runs/hopper`.

# %%
import tempfile
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from pbfd_torch import view
from pbfd_torch.learning.evaluation import Policy, tried
from pbfd_torch.learning.ppo import Ppo, PpoTrainer
from pbfd_torch.learning.training_env import EnvSettings

torch.set_num_threads(1)
warnings.filterwarnings("ignore", module="torchrl")
folder = Path(tempfile.mkdtemp()) / "pole"

# %% [markdown]
# The trainer writes checkpoint, curve and picture into its folder after every batch, and goes on from there with `resume=True`.

# %%
settings = Ppo(EnvSettings("cart-pole", num_envs=16, seed=3), horizon=32, epochs=10, minibatch=128, learning_rate=1e-3)
rows = PpoTrainer(settings, folder).run(frames=12_000)
print(f"steps balanced in the first batch: {rows[0].mean_length:.0f}; {rows[-1].seconds:.0f} s for {rows[-1].frames} steps")

# %%
policy = Policy.load(folder / "checkpoint.pt")
trials = {on: tried(policy, policy.settings, on, episodes=8) for on in ("pbfd", "newton-euler", "mujoco")}
for on, trial in trials.items():
    print(f"{on:13s} return {trial.mean:6.1f} ± {trial.spread:.1f}, unsolved: {trial.unsolved}")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
ended = [row for row in rows if row.episodes]
left.plot([row.frames for row in ended], [row.mean_return for row in ended])
left.set(xlabel="environment steps", ylabel="return of the episodes that end", title="training")
for on, trial in trials.items():
    right.plot(trial.rollout.time, trial.rollout.q[:, 0, 1], label=on)
right.set(xlabel="time [s]", ylabel="angle of the pole [rad]", title="the same start in three simulators")
right.legend()
plt.show()

# %% [markdown]
# Each trial's rollout is a record like any other, and can be looked at, here MuJoCo's as a ghost over ours. A notebook shows the
# viewer in place when `shown` is the last line of a cell; it is closed at once here.

# %%
shown = view(trials["pbfd"].rollout, ghost=trials["mujoco"].rollout)
assert shown.address.startswith("http://localhost:")
shown.close()

# %%
assert trials["pbfd"].mean > 3 * rows[0].mean_return
assert all(trial.unsolved == 0 for trial in trials.values())
assert all(trial.mean > 0.7 * trials["pbfd"].mean for trial in trials.values())
