# %% [markdown]
# # 1. The pendulum, and what one swing tells
#
# A pendulum hangs on the flange of a robot arm, with an encoder on its spindle. Before anything
# can balance it, somebody has to know how fast it falls. One free swing is enough.
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

# %% [markdown]
# ## Three numbers
#
# With the angle $\theta$ from hanging, the moment of inertia $I$, the friction $b$, the mass $m$ and
# the distance $l$ of its centre, the pendulum obeys equation (8) of the paper
#
# $$ I \ddot\theta + b \dot\theta + m g l \sin\theta = 0 . $$
#
# Divide by $I$, and only two numbers remain: $w_2 = m g l / I$ and $c = b / I$. When the pivot moves, a
# third one acts, $k = m l / I$, the pull of the pivot's acceleration. Nobody has to weigh anything.

# %%
pendulum = eq.PendulumParameters(w2=64.0, k=64.0 / g, c=0.2)
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
# An encoder of 8192 counts, read 500 times a second. The pendulum is released at 40 degrees.

# %%
swing = eq.simulate_swing(
    pendulum, theta0=radians(40.0), duration=10.0, rate_hz=500.0, counts_per_rev=8192, seed=1
)
figure, axes = plt.subplots(figsize=(8, 3))
axes.plot(swing.time, np.degrees(swing.theta))
axes.set(xlabel="time [s]", ylabel="angle from hanging [deg]", title="A free swing")
# %% [markdown]
# ## Identification
#
# `identify` fits equation (8), with the release, the zero of the encoder, and whatever friction the
# recording shows. Each number comes with a 95 % interval.

# %%
identified = eq.identify(swing)
identified

# %%
for name in ("w2", "k", "c"):
    estimate, truth = getattr(identified, name), getattr(pendulum, name)
    low, high = estimate.interval
    print(
        f"{name:2}  true {truth:8.4f}   found {estimate.value:8.4f}   95 %: {low:.4f} to {high:.4f}"
    )

# %% [markdown]
# **Exercise 2.** An interval of 95 % misses the truth once in twenty times. See for yourself: simulate
# 20 swings with the seeds 0 to 19, identify each, and count how often the interval of `w2` holds the
# truth, 64.0. (Use 4 s and 500 Hz, with a noise of 0.002 rad.)


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
    "Simulate with noise=0.002 and seed=seed, identify, and compare 64.0 with both ends.",
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
# %% [markdown]
# **Exercise 3.** After which time has the lean of our pendulum ($w_2 = 64$) doubled? Use the growing part,
# $e^{w t} = 2$.

# %% tags=["exercise"]
doubled_after = ...  # [s]

# %%
check(
    3, doubled_after, lambda t: abs(t - np.log(2) / 8) < 1e-3, "t = log(2) / w, and w = sqrt(w2)."
)

# %% [markdown]
# **Exercise 4.** A longer pendulum falls more slowly. A uniform rod of length $L$ turns about its end with
# $I = m L^2 / 3$ and $l = L / 2$. How long is a rod with $w_2 = 64$?

# %% tags=["exercise"]
length = ...  # [m]

# %%
check(4, length, lambda length: abs(length - 1.5 * g / 64) < 1e-3, "w2 = m g l / I = 3 g / (2 L).")

# %% [markdown]
# A delay of 30 ms lets a lean of this pendulum grow by a quarter before anything can be done about it.
# Remember this number for notebook 3.

# %%
print(
    f"e^(w t) after 30 ms: {np.exp(8 * 0.03):.2f}; a quarter turn takes {pi / 2 / 8:.2f} s hanging"
)
