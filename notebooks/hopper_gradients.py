# %% [markdown]
# # Gradients through the foot of a hopper
#
# The one-legged hopper can rise only by pushing against the ground. How high its torso is at the end depends on the controls
# through contact and friction at the foot. The derivative is exact: it agrees with central differences, and a descent along it
# finds a jump.

# %%
import matplotlib.pyplot as plt
import torch

from pbfd_torch.optimize.tasks import Hopper

torch.set_num_threads(1)

# %%
task = Hopper(worlds=2)
shooting = task.shooting
x = task.starts.requires_grad_()
plan, motion = shooting.played(x)
height = motion.q[-1, :, 1]
(gradient,) = torch.autograd.grad(height.sum(), x)
print(f"height of the torso at the end: {height.tolist()} m")
print(f"unsolved steps: {int((~motion.solved).sum())}, with doubtful derivatives: {int((motion.doubts != 0).sum())}")

# %% [markdown]
# Against central differences along the gradient, both worlds at once:

# %%
direction = gradient / torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)
step = 1e-5
with torch.no_grad():
    up, down = (shooting.played(x + sign * step * direction)[1].q[-1, :, 1] for sign in (1, -1))
measured = (up - down) / (2 * step)
along = (gradient * direction).sum(-1)
print(f"derivative: {along.tolist()}, differences: {measured.tolist()}")

# %% [markdown]
# Adam along these gradients; the torso is to be 1.4 m high, upright.

# %%
shot = shooting.descend(task.cost, task.starts, lambda values: torch.optim.Adam(values, lr=0.1), 8)
reached = task.reached(shot.trajectory)
print(f"goal: {task.criterion}")
print(f"reached: {int(reached.sum())} of 2")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
for world in range(2):
    left.plot(motion.q[:, world, 1].detach(), color="tab:red", label="random controls" if world == 0 else None)
    left.plot(shot.trajectory.q[:, world, 1].detach(), color="tab:blue", label="found" if world == 0 else None)
left.set(xlabel="step", ylabel="height of the torso [m]", title="jumps")
left.legend()
right.semilogy(shot.history)
right.set(xlabel="iteration", ylabel="lowest cost so far", title="cost of each world")
plt.show()

# %%
assert bool(((along - measured).abs() <= 1e-3 * measured.abs() + 1e-6).all())
assert bool(reached.all())
assert bool((shot.trajectory.q[-1, :, 1] > motion.q[-1, :, 1] + 0.1).all())
