# %% [markdown]
# # Swinging up an arm whose motors are too weak
#
# Two links hang from a shoulder. Its motor cannot hold the arm level, so the arm must swing. iLQR linearises all steps of all
# worlds in one batch, finds better controls within the limits, and tries several step lengths at once, again as one batch.

# %%
import math

import matplotlib.pyplot as plt
import torch

from pbfd_torch.optimize import Search, ilqr
from pbfd_torch.optimize.tasks import ArmSwingUp
from pbfd_torch.optimize.tasks.arm_swing_up import DT, EFFORT

torch.set_num_threads(1)

# %%
task = ArmSwingUp(worlds=4, seed=3)
simulator = task.simulator
plan = task.plan(simulator)
improved = ilqr(simulator, plan.start, plan.controls, task.cost(simulator), task.limits, Search(iterations=20))
reached = task.reached(simulator, improved)
print(f"goal: {task.criterion}")
print(f"reached: {int(reached.sum())} of 4 after {len(improved.history) - 1} iterations")
print(f"unsolved steps: {int(improved.unsolved.sum())}, with doubtful derivatives: {int(improved.doubtful.sum())}")

# %%
best = int(improved.motion.cost.argmin())
q, controls = improved.motion.states.q[:, best], improved.controls[:, best]
figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
for k in range(0, len(q), 2):
    a, b = q[k, 0], q[k].sum()
    x = [0.0, float(-0.5 * a.sin()), float(-0.5 * (a.sin() + b.sin()))]
    z = [0.0, float(-0.5 * a.cos()), float(-0.5 * (a.cos() + b.cos()))]
    axes[0].plot(x, z, "-o", color=plt.get_cmap("viridis")(k / len(q)), markersize=3)
axes[0].set(xlabel="x [m]", ylabel="z [m]", title="the arm, dark to bright", aspect="equal")
for k, name in enumerate(("shoulder", "elbow")):
    axes[1].step(DT * torch.arange(len(controls)), controls[:, k], where="post", color=f"C{k}", label=name)
    axes[1].axhline(EFFORT[k], color=f"C{k}", linestyle=":")
    axes[1].axhline(-EFFORT[k], color=f"C{k}", linestyle=":")
axes[1].set(xlabel="time [s]", ylabel="torque [N m]", title="torques and their limits")
axes[1].legend()
axes[2].semilogy(improved.history)
axes[2].set(xlabel="iteration", ylabel="cost", title="cost of each world")
plt.show()

# %% [markdown]
# The best world stands upright, the torques stay within their limits, and no cost has ever risen.

# %%
assert bool(reached[best])
assert float((q[-1] - torch.tensor([math.pi, 0.0])).abs().max()) < 0.1
assert bool((improved.controls.abs() <= torch.tensor(EFFORT)).all())
assert bool((improved.history[1:] <= improved.history[:-1]).all())
assert int(improved.unsolved.sum()) == 0
