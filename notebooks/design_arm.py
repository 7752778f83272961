# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # An arm and its motion, designed together
#
# A planar arm hangs from the ceiling above a table and has to bring its tip to three places, each within .6 s and with as little
# effort as possible. How long should its two links be? Long links reach far but weigh more and hit the table; short ones do not
# reach. And every choice of lengths has its own best way to move. Gradients through the simulation find both at once.

# %%
import math

import matplotlib.pyplot as plt
import torch
from torch import Tensor

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Sphere
from pbfd_torch.gradients.parameters import with_parameters
from pbfd_torch.identify import Bounds, Stopping, levenberg_marquardt, linearized
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.joint_springs import JointDamping
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.articulation import pseudo_inertia
from pbfd_torch.tree.kinematics import place

torch.set_num_threads(1)
torch.set_default_dtype(torch.float64)

# %% [markdown]
# ## A scene of which the lengths are parameters
#
# The arm is built once, for some lengths. A length is no parameter of the simulator; it is what three of its parameters follow
# from: where the elbow is (`joint_frame`), how the links' mass is spread (`pseudo_inertia`), and where the balls sit that can
# touch the table (`position` of the contact). `with_parameters` puts all three in, with their gradients.

# %%
DENSITY, RADIUS, BALL, TABLE = 2.0, 0.02, 0.03, -0.75  # [kg/m], [m], [m], height of the table below the shoulder [m]
KP, KV = 30.0, 3.0  # of the servos [N m/rad], [N m s/rad]
FIRST = torch.tensor([0.3, 0.3])  # lengths to begin with [m]


def arm() -> Scene:
    turn = {name: Joint(name, JointKind.HINGE, (0.0, -1.0, 0.0)) for name in ("shoulder", "elbow")}
    rod = {"mass": 1.0, "inertia": ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.01))}  # replaced below
    upper = Link("upper", joints=(turn["shoulder"],), **rod)
    fore = Link("fore", "upper", position=(float(FIRST[0]), 0.0, 0.0), joints=(turn["elbow"],), **rod)
    a = Articulation.from_links([upper, fore])
    balls = [Collider(f"end of {name}", name, Sphere(BALL), (0.3, 0.0, 0.0)) for name in ("upper", "fore")]
    table = HalfSpace(offset=TABLE)
    contact = Contact.between(a, balls, table, NormalForce.for_weight(20.0, 2e-3), CoulombFriction(0.3, slip_speed=0.01))
    motors = Actuators.from_list(a, [Actuator.position(name, name, KP, KV) for name in turn])
    damping = JointDamping(torch.full((2,), 0.02))
    return Scene(a, (Inertia(), contact, damping, motors), torch.tensor([0.0, 0.0, -9.81]), balls, (table,), "arm")


def with_lengths(scene: Scene, lengths: Tensor) -> Scene:
    """The same arm with other lengths `[*batch, 2]` [m]."""
    along = torch.tensor([1.0, 0.0, 0.0])
    elbow = torch.zeros(2, 4, 4)
    elbow[1, 0, 3] = 1.0  # at the end of the upper arm
    mass = DENSITY * lengths
    across = lengths.square() / 12 + RADIUS**2 / 4
    moments = mass[..., None] * torch.stack((torch.full_like(lengths, RADIUS**2 / 2), across, across), -1)
    return with_parameters(
        scene,
        {
            "articulation.joint_frame": torch.eye(4) + lengths[..., :1, None, None] * elbow,
            "articulation.pseudo_inertia": pseudo_inertia(mass, 0.5 * lengths[..., None] * along, torch.diag_embed(moments)),
            "terms.1.position": lengths[..., None] * along,
        },
    )


# %% [markdown]
# ## What a good arm does
#
# One world per target. At the end the tip is there, and at rest; on the way the servos' torques are small. All that is squared and
# summed: a miss of 2 cm, .5 rad/s at the end, and 4 N²m²s of effort cost 1 each. So the design is a least-squares problem of 26
# numbers: the logarithms of 2 lengths, and 4 angles that a servo is told for each joint and target, with straight lines between.

# %%
TARGETS = torch.tensor([[0.65, 0.0, -0.3], [0.45, 0.0, 0.45], [-0.5, 0.0, -0.5]])  # [m]
DT, STEPS, KNOTS = 0.03, 20, 4
START = torch.tensor([-0.5 * torch.pi, 0.3])  # it hangs, a little bent
scene = arm()

place_in_time = torch.linspace(0, KNOTS - 1, STEPS)
BETWEEN = (1 - (place_in_time[:, None] - torch.arange(KNOTS)).abs()).clamp_min(0)  # [steps, knots]


def unpacked(x: Tensor) -> tuple[Tensor, Tensor]:
    """Lengths `[*batch, 1, 2]` and what servos are told, `[steps, *batch, targets, 2]` [rad], from x `[*batch, 26]`."""
    knots = START + x[..., 2:].unflatten(-1, (KNOTS, len(TARGETS), 2))
    return x[..., None, :2].exp(), torch.einsum("sk,...kti->s...ti", BETWEEN, knots)


def ends(lengths: Tensor, q: Tensor) -> Tensor:
    """Where both links end, `[*, 2, 3]`."""
    poses = place(with_lengths(scene, lengths).articulation, q).poses[..., :3, :]
    return lengths[..., None] * poses[..., 0] + poses[..., 3]


def swing(x: Tensor) -> tuple[Tensor, Tensor]:
    """q and v `[steps + 1, *batch, targets, 2]`."""
    lengths, told = unpacked(x)
    simulator = Simulator(with_lengths(scene, lengths), DT)
    q = START.expand(*x.shape[:-1], len(TARGETS), 2).contiguous()
    made = simulator.trajectory(simulator.initial_state(q, torch.zeros_like(q)), told)
    return made.q, made.v


def torques(told: Tensor, q: Tensor, v: Tensor) -> Tensor:
    """Of the servos after every step [N m]."""
    return KP * (told - q[1:]) - KV * v[1:]


def residual(x: Tensor) -> Tensor:
    lengths, told = unpacked(x)
    q, v = swing(x)
    miss = ends(lengths, q[-1])[..., 1, :] - TARGETS
    effort = torques(told, q, v).movedim(0, -3) * (DT / 4.0) ** 0.5
    return torch.cat(((miss / 0.02).flatten(-2), (v[-1] / 0.5).flatten(-2), effort.flatten(-3)), -1)


# %% [markdown]
# ## Together
#
# Levenberg–Marquardt needs the Jacobian, which comes forward through the simulation: every number is a copy of the three worlds
# more, so 78 worlds are simulated at once. At first
# the servos are told to turn the stretched arm straight towards each target.

# %%
towards = torch.atan2(TARGETS[:, 2], TARGETS[:, 0]) - START[0]
ramp = torch.linspace(0.25, 1.0, KNOTS)[:, None] * towards
first = torch.cat((FIRST.log(), torch.stack((ramp, torch.zeros_like(ramp)), -1).flatten()))
free = torch.full_like(first, torch.inf)
lower, upper = -free, free.clone()
lower[:2], upper[:2] = math.log(0.15), math.log(0.8)  # lengths that can be built [m]
bounds = Bounds(lower, upper, torch.ones_like(first))
fit = levenberg_marquardt(linearized(residual), first, bounds, Stopping(iterations=15, step=1e-3, decrease=3e-3))

lengths, told = unpacked(fit.x)
q, v = swing(fit.x)
torque = torques(told, q, v)
places = ends(lengths, q)
miss = torch.linalg.vector_norm(places[-1, :, 1] - TARGETS, dim=-1)
effort = DT * torque.square().sum((0, -1))
print(f"lengths {lengths[0, 0]:.3f} m and {lengths[0, 1]:.3f} m after {len(fit.history) - 1} iterations")
print(f"cost {fit.history[0]:.0f} → {fit.history[-1]:.2f}")
for k in range(len(TARGETS)):
    print(f"target {k + 1}: missed by {1e3 * miss[k]:.1f} mm, effort {effort[k]:.2f} N²m²s")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(12, 3.5), layout="constrained")
left.semilogy(fit.history, "-o", color="#08519c", markersize=4)
left.set(xlabel="iteration", ylabel="cost", title="how the design got better")
left.grid(alpha=0.3)
for k in range(len(TARGETS)):
    for joint, line in enumerate(("-", "--")):
        name = f"target {k + 1}, {('shoulder', 'elbow')[joint]}"
        right.plot(DT * torch.arange(STEPS), torque[:, k, joint], line, color=plt.get_cmap("tab10")(k), label=name)
right.set(xlabel="time [s]", ylabel="torque [N m]", ylim=(-6, 8.5), title="what the servos do")
right.legend(frameon=False, ncols=len(TARGETS), fontsize=8)
right.grid(alpha=0.3)

# %%
figure, axes = plt.subplots(1, len(TARGETS), figsize=(12, 4.2), layout="constrained", sharey=True)
for k, panel in enumerate(axes):
    for step in range(0, STEPS + 1, 2):
        x = [0.0, *places[step, k, :, 0].tolist()]
        z = [0.0, *places[step, k, :, 2].tolist()]
        panel.plot(x, z, "-o", color=plt.get_cmap("viridis")(step / STEPS), markersize=4, linewidth=2)
    panel.plot(*TARGETS[k, [0, 2]], "*", color="#d94801", markersize=16, zorder=3)
    panel.axhline(TABLE, color="0.4", linewidth=3)
    panel.set_aspect("equal")
    panel.set(title=f"target {k + 1}", xlabel="x [m]", xlim=(-0.9, 0.9), ylim=(-0.85, 0.7))
axes[0].set_ylabel("z [m]")
plt.show()

# %% [markdown]
# ## Is the gradient right?
#
# The derivative of the cost by the lengths goes through all three parameters. Backward through the simulation and by differences of
# whole simulations, where the fit began:

# %%
probe = first.clone().requires_grad_()
(slope,) = torch.autograd.grad(0.5 * residual(probe).square().sum(), probe)
steps = 1e-5 * torch.eye(len(first))[:2]
differences = 0.5 * (residual(first + steps).square() - residual(first - steps).square()).sum(-1) / 2e-5
print("gradient   ", slope[:2])
print("differences", differences)
assert torch.allclose(slope[:2], differences, rtol=1e-5)
assert bool((miss < 0.02).all())
