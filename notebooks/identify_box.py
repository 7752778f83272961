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
# # What does the box weigh, where is its middle, how rough is the floor?
#
# A box of unknown content is thrown by a known force, tumbles, lands and slides to rest. A camera sees where it is, with 1 %
# noise. From that motion alone: its mass, its centre of mass and its friction with the floor, and how well the motion tells them.
#
# The force must be known: in free flight all bodies fall alike, and on the floor Coulomb friction slows a heavy box as fast as a
# light one. Without the force the report at the end would say that the mass is not determined.

# %%
import math

import matplotlib.pyplot as plt
import torch

from pbfd_torch import Articulation, Joint, JointKind, Link, Scene, Simulator
from pbfd_torch.contact.half_space import HalfSpace
from pbfd_torch.contact.shapes import Collider, Sphere
from pbfd_torch.identify import Case, CenterOfMass, Configurations, Experiment, Identification, Mass, Parameter, Stopping
from pbfd_torch.identify.pictures import draw, draw_fit
from pbfd_torch.identify.report import report
from pbfd_torch.terms.actuators import Actuator, Actuators
from pbfd_torch.terms.contact import Contact
from pbfd_torch.terms.coulomb_friction import CoulombFriction
from pbfd_torch.terms.inertia import Inertia
from pbfd_torch.terms.normal_force import NormalForce
from pbfd_torch.tree.kinematics import retract
from pbfd_torch.tree.rotations import quaternion_exp

torch.set_num_threads(1)
torch.set_default_dtype(torch.float64)

# %% [markdown]
# ## The box
#
# Three slides and a ball joint let it move freely, and the slides carry motors: a control is a force in world axes that acts on the
# middle of the hull.

# %%
HALF, ROUNDING = (0.15, 0.12, 0.1), 0.01  # half extents of the hull, radius of its corners [m]


def box(mass: float, com: tuple[float, float, float], mu: float) -> Scene:
    x, y, z = (2 * h for h in HALF)
    about = (mass / 12 * (y * y + z * z), mass / 12 * (x * x + z * z), mass / 12 * (x * x + y * y))
    inertia = ((about[0], 0.0, 0.0), (0.0, about[1], 0.0), (0.0, 0.0, about[2]))
    slides = [Joint(name, JointKind.SLIDE, axis) for name, axis in (("x", (1, 0, 0)), ("y", (0, 1, 0)), ("z", (0, 0, 1)))]
    link = Link("box", joints=(*slides, Joint("turn", JointKind.BALL)), mass=mass, com=com, inertia=inertia)
    a = Articulation.from_links([link])
    corners = [
        Collider(
            f"corner {i} {j} {k}", "box", Sphere(ROUNDING), tuple(s * (h - ROUNDING) for s, h in zip((i, j, k), HALF, strict=True))
        )
        for i in (-1, 1)
        for j in (-1, 1)
        for k in (-1, 1)
    ]
    floor = HalfSpace()
    contact = Contact.between(a, corners, floor, NormalForce.for_weight(20.0, 2e-3), CoulombFriction(mu, slip_speed=0.01))
    force = Actuators.from_list(a, [Actuator.motor(name, name) for name in "xyz"])
    return Scene(a, (Inertia(), contact, force), torch.tensor([0.0, 0.0, -9.81]), corners, (floor,), "tossed box")


# %% [markdown]
# ## The experiment
#
# Four throws of 30 N up and 12 N forward for .18 s. The real numbers are only used to make the data.

# %%
REAL = torch.tensor([2.0, 0.02, -0.015, 0.01, 0.4])  # mass [kg], centre of mass [m], μ
real = box(2.0, (0.02, -0.015, 0.01), 0.4)
dt, steps, runs, noise = 0.03, 30, 4, 0.01

q = real.articulation.rest.repeat(runs, 1)
q[:, 2] = 0.3
q[:, 3:] = quaternion_exp(torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.3, 0.1], [0.0, -0.4, 0.2]]))
v = q.new_zeros(runs, 6)
forces = q.new_zeros(steps, runs, 3)
forces[:6, :, 0], forces[:6, :, 2], forces[:6, 1, 1] = 12.0, 30.0, 5.0

simulator = Simulator(real, dt)
true_motion = simulator.trajectory(simulator.initial_state(q, v), forces).q[1:]
size = (true_motion[..., :3].amax((0, 1)) - true_motion[..., :3].amin((0, 1))).amax()
deviation = noise * torch.cat((size.expand(3), torch.full((3,), math.pi)))
generator = torch.Generator().manual_seed(1)
data = retract(real.articulation, true_motion, deviation * torch.randn(steps, runs, 6, generator=generator))
print(f"noise: {1e3 * float(deviation[0]):.1f} mm and {math.degrees(float(deviation[3])):.1f}°")

# %% [markdown]
# ## The fit
#
# Three random starts, all in one batch, each first from the flight alone, then from longer and longer parts of the motion: what
# happens after an impact depends so strongly on what was before that a fit of the whole motion from afar ends anywhere.

# %%
believed = Case(box(2.0, (0.0, 0.0, 0.0), 0.4), q, v)
unknowns = [Mass("box"), CenterOfMass("box"), Parameter("μ", ("terms.1.friction.mu",), lower=0.0, upper=1.0)]
identification = Identification(Experiment(believed, Configurations(data, deviation), dt, forces), unknowns)

spread = torch.tensor([0.1, 0.01, 0.01, 0.01, 0.15])
starts = identification.start + spread * torch.randn(3, 5, generator=generator)
print("starts (mass, centre of mass, μ):")
print(identification.values(starts))

found = identification.fit(starts, horizons=(12, 19), stopping=Stopping(25, step=1e-3, decrease=1e-3))
print(report(found))

# %% [markdown]
# How far off is it, beside how far off it said it might be?

# %%
figure = plt.figure(figsize=(13, 3.8), layout="constrained")
draw(figure, found, truth=REAL)

# %% [markdown]
# And what the camera saw beside what the fitted box does:

# %%
fitted = identification.experiment.simulated(identification.case(found.best.fit.x))[0]
time = dt * torch.arange(1, steps + 1)
figure, axes = plt.subplots(1, runs, figsize=(13, 3.5), layout="constrained", sharey=True)
for run, panel in enumerate(axes):
    draw_fit(panel, time, data[:, run, :3], fitted[:, run, :3], "xyz")
    panel.set_title(f"throw {run + 1}")
axes[0].set_ylabel("position [m]")
plt.show()

# %%
off = found.best.values - REAL
com = torch.linalg.vector_norm(off[1:4]) / torch.linalg.vector_norm(REAL[1:4])
print(f"mass off by {100 * off[0] / REAL[0]:.2f} %, centre of mass by {100 * com:.2f} %, μ by {100 * off[4] / REAL[4]:.2f} %")
assert max(abs(float(off[0] / REAL[0])), float(com), abs(float(off[4] / REAL[4]))) < 0.02
