# %% [markdown]
# # 1. The pendulum, and what one swing tells
#
# A pendulum hangs on the flange of a robot arm, with an encoder on its spindle. Before anything
# can balance it, its rate of fall has to be known. One free swing is enough.
#
# **You need** nothing but Equipoise. Run a cell with Shift+Enter. Where you see `...`, write your
# own; the cell below tells whether it is right.

# %%
from math import pi, radians, sqrt

import matplotlib.pyplot as plt
import numpy as np
from checks import check
from scipy.constants import g

import equipoise as eq
from equipoise.report.figures import free_swing

# %% [markdown]
# ## Three numbers
#
# With the angle $\theta$ from hanging, the moment of inertia $I$, the friction $b$, the mass $m$ and
# the distance $l$ of its centre, the pendulum obeys equation (8) of the paper
#
# $$ I \ddot\theta + b \dot\theta + m g l \sin\theta = 0 . $$
#
# Divide by $I$, and only two numbers remain: $w_2 = m g l / I$ and $c = b / I$. When the pivot moves, a
# third one acts, $k = m l / I = w_2 / g$, the coupling to the pivot's acceleration. No part has to be weighed.

# %%
pendulum = eq.PendulumParameters(w2=64.0, k=64.0 / g, c=0.2)
print(f"period of a small swing: {2 * pi / sqrt(pendulum.w2):.3f} s")
pendulum

# %% [markdown]
# **Exercise 1.** The paper's pendulum has a period of about 0.75 s. Small swings have the period
# $T = 2 \pi / \sqrt{w_2}$. What is its $w_2$?

# %% tags=["exercise"]
w2 = ...

# %%
check(1, w2, lambda w2: abs(w2 - 70.18) < 0.1, "Solve T = 2 pi / sqrt(w2) for w2.")

# %% [markdown]
# ## A recording
#
# An encoder of 8192 counts, read 500 times a second, with noise of 0.002 rad. The pendulum is released at
# 40 degrees. `eq.read_swing` reads a recording of your own.

# %%
RECORDER = {"theta0": radians(40.0), "rate_hz": 500.0, "counts_per_rev": 8192, "noise": 0.002}
swing = eq.simulate_swing(pendulum, duration=10.0, seed=1, **RECORDER)
figure, axes = plt.subplots(figsize=(8, 3))
axes.plot(swing.time, np.degrees(swing.theta))
axes.set(xlabel="time [s]", ylabel="angle from hanging [deg]", title="A free swing")
plt.show()

# %% [markdown]
# ## Identification
#
# `identify` fits equation (8), with the state at the release and the zero of the encoder. Each number comes
# with a 95 % interval.

# %%
identified = eq.identify(swing)
identified

# %%
for name in ("w2", "k", "c"):
    estimate, truth = getattr(identified, name), getattr(pendulum, name)
    low, high = estimate.interval
    print(
        f"{name:2}  true {truth:9.5f}   found {estimate.value:9.5f}   95 %: {low:.5f} to {high:.5f}"
    )

# %% [markdown]
# The residual, recording minus fit, tells whether the model is right. It should look like noise.

# %%
free_swing(swing, identified)

# %% [markdown]
# **Exercise 2.** An interval of 95 % misses the truth once in twenty times. See for yourself: simulate
# 20 swings with the seeds 0 to 19, identify each, and count how often the interval of `w2` holds the
# truth, 64.0. (Use 4 s, and the same recorder: `eq.simulate_swing(pendulum, duration=..., seed=..., **RECORDER)`.)


# %% tags=["exercise"]
def holds(seed):
    """Return whether the interval of w2 from one noisy swing holds the truth."""
    return ...


# %%
held = [holds(seed) for seed in range(20)]
check(
    2,
    ... if ... in held else held,
    lambda held: 15 <= sum(held) <= 20,
    "Simulate with seed=seed, identify, and compare 64.0 with both ends.",
)

# %% [markdown]
# ## A wrong model
#
# Equation (8) has viscous friction only. Few bearings do. Here is the same pendulum with dry friction as well:

# %%
dry = pendulum._replace(coulomb=0.3)
dry_swing = eq.simulate_swing(dry, duration=10.0, seed=2, **RECORDER)
wrong = eq.identify(dry_swing)
low, high = wrong.c.interval
print(f"c: true {dry.c:.3f}, found {wrong.c.value:.3f}, 95 %: {low:.3f} to {high:.3f}")
for warning in wrong.fit.warnings:
    print("warning:", warning)

# %%
free_swing(dry_swing, wrong)

# %% [markdown]
# The interval misses the truth by far: it is valid only if the model is. Here the residual is no noise, and
# a warning names the remedy.
#
# **Exercise 3.** Name the friction model that explains this recording. (`eq.identify` takes it as the setting
# `identification.friction`.)

# %% tags=["exercise"]
friction = ...


# %%
def dry_friction_with(model):
    """Return the dry friction [1/s²] that a friction model finds in the recording, as an estimate."""
    settings = eq.resolve(overrides=[f"identification.friction={model}"]).identification
    return eq.identify(dry_swing, settings).coulomb


check(
    3,
    friction,
    lambda model: dry_friction_with(model).low <= dry.coulomb <= dry_friction_with(model).high,
    "The warning gives it behind --friction.",
)

# %% [markdown]
# ## Upside down
#
# Turned by half a turn, with $\varphi$ from upright, the same numbers say how fast it falls. Near upright
# $\ddot\varphi = w_2 \varphi$, so that a small lean grows as $e^{w t}$ with $w = \sqrt{w_2}$.

# %%
time = np.linspace(0.0, 0.5, 200)
figure, axes = plt.subplots(figsize=(8, 3))
for w2_of in (30.0, 64.0, 150.0):
    axes.plot(time, np.degrees(radians(0.5) * np.cosh(sqrt(w2_of) * time)), label=f"w2 = {w2_of:g}")
axes.axhline(11.0, color="0.6", linestyle="--")
axes.set(
    xlabel="time [s]",
    ylabel="angle from upright [deg]",
    ylim=(0, 20),
    title="Falling from 0.5 degrees",
)
axes.legend()
plt.show()

# %% [markdown]
# **Exercise 4.** After which time has the lean of our pendulum ($w_2 = 64$) doubled? Use the growing part,
# $e^{w t} = 2$.

# %% tags=["exercise"]
doubled_after = ...  # [s]

# %%
check(
    4, doubled_after, lambda t: abs(t - np.log(2) / 8) < 1e-3, "t = log(2) / w, and w = sqrt(w2)."
)

# %% [markdown]
# A delay of the robot lets a falling pendulum fall further before anything can be done about it. Remember this
# number for notebook 3.

# %%
print(f"in 30 ms a lean of this pendulum grows by a factor of {np.exp(8 * 0.03):.2f}")
