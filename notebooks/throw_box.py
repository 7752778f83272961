# %% [markdown]
# # Throwing a box onto a target
#
# A box is thrown, lands, slides under Coulomb friction and comes to rest. How fast, and in what direction, must it leave so that it
# stops at a given place? Derivatives go through the flight, the impact and the sliding: Gauss–Newton needs a few simulations only.

# %%
import matplotlib.pyplot as plt
import torch

from pbfd_torch.optimize import Stopping
from pbfd_torch.optimize.tasks import BoxThrow
from pbfd_torch.optimize.tasks.box_throw import TARGET

torch.set_num_threads(1)

# %% [markdown]
# Eight random throws, as one batch of worlds. Each has another spin and another upward velocity; the two horizontal velocities are
# to be found. The residual is the way from the target to where the box ends up, and its velocity there.

# %%
task = BoxThrow(worlds=8)
shooting = task.shooting
before = shooting.played(task.starts)[1]
shot = shooting.gauss_newton(task.residual, task.starts, Stopping(6))
after = shot.trajectory
print(f"goal: {task.criterion}")
print(f"reached before: {int(task.reached(before).sum())} of 8, after: {int(task.reached(after).sum())} of 8")
print(f"unsolved steps: {int(shot.unsolved.sum())}, with doubtful derivatives: {int(shot.doubtful.sum())}")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
for world in range(8):
    left.plot(*before.q[:, world, :2].T, color="tab:red", alpha=0.6, label="first throws" if world == 0 else None)
    left.plot(*after.q[:, world, :2].detach().T, color="tab:blue", alpha=0.8, label="found" if world == 0 else None)
left.plot(*TARGET, "k*", markersize=14, label="target")
left.set(xlabel="x [m]", ylabel="y [m]", title="paths of the boxes, seen from above", aspect="equal")
left.legend()
right.semilogy(shot.history.clamp_min(1e-12))
right.set(xlabel="iteration", ylabel="cost", title="cost of each world")
plt.show()

# %% [markdown]
# Every box stops within a centimetre of the target.

# %%
assert not bool(task.reached(before).any())
assert bool(task.reached(after).all())
assert int(shot.unsolved.sum()) == 0
