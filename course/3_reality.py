# %% [markdown]
# # 3. Why it falls on the robot
#
# In simulation a table can survive a minute. The paper's survived five seconds on the robot. Where do they
# differ? Here you take a table that balances in a world without faults, and add the faults of a real rig one
# by one.

# %%
import matplotlib.pyplot as plt
import numpy as np
from checks import check
from scipy.stats import t as student

import equipoise as eq
from equipoise.model.worlds import CLEAN, EFFECTS

# %% [markdown]
# ## A table for a perfect world
#
# The recipe `paper` trains in the paper's simulation: the arm follows each command at once, and the state is
# known. Of the late tables of a training it keeps the one that survives longest there, as a laboratory would
# before it takes a table to its robot.

# %%
settings = eq.resolve("paper", overrides=["evaluation.trials=25", "evaluation.duration=30"])
table = eq.train(eq.shipped_pendulum(), eq.iiwa(7), settings, seed=0, workers=2)
at_home = eq.evaluate(table, world="ideal", workers=2)
at_home

# %% [markdown]
# ## A twin without faults
#
# The digital twin is a physics engine behind the robot's protocol. `CLEAN` switches each of its effects
# off. So this world has no delay to speak of, no jitter, an encoder without steps.

# %%
nominal = eq.read_world("twin:nominal")


def twin(**changes):
    """Return the clean twin with some numbers changed."""
    return nominal._replace(
        name="twin:" + "-".join(changes or ["clean"]),
        settings=nominal.settings.model_copy(update=CLEAN | changes),
    )


def trials(world):
    """Return the trials of the table in a world; trial i has the same start in each world."""
    return eq.evaluate(table, world=world, with_baselines=False, workers=2).results


def mean(seconds):
    """Return the mean of some seconds, and half its 95 % interval (Student's)."""
    count = len(seconds)
    half = student.ppf(0.975, count - 1) * np.std(seconds, ddof=1) / np.sqrt(count)
    return np.mean(seconds), half


def text(seconds):
    """Return the mean with its interval as text."""
    middle, half = mean(seconds)
    return f"{middle:.1f} ± {half:.1f} s"


def draw(values, results, label):
    """Draw the mean survival with its 95 % interval."""
    middle, half = np.transpose([mean(policy.survival) for policy in results])
    _, axes = plt.subplots(figsize=(6, 3))
    axes.errorbar(values, middle, yerr=half, marker="o", capsize=3)
    axes.set(xlabel=label, ylabel="mean survival [s]", ylim=(0, 32))
    plt.show()


clean = trials(twin())
print("on its own plant", text(at_home.results.survival))
print("on a clean twin ", text(clean.survival))

# %% [markdown]
# Behind ± is half the 95 % interval of the mean. If all trials survived, the trials show no spread, and the interval
# has no width.
#
# ## Delay
#
# A command takes effect some milliseconds after it was computed.

# %%
delays = (0.0, 0.005, 0.010, 0.020, 0.030)
delayed = [clean, *(trials(twin(transport=delay)) for delay in delays[1:])]
draw(np.multiply(1e3, delays), delayed, "transport delay [ms]")

# %% [markdown]
# **Exercise 1.** From notebook 1: by which factor does a lean grow in 30 ms, for $w_2 = 70.2$?

# %% tags=["exercise"]
growth = ...

# %%
check(
    1, growth, lambda g: abs(g - np.exp(np.sqrt(70.2) * 0.03)) < 0.01, "exp(w t), and w = sqrt(w2)."
)

# %% [markdown]
# The lean grows by less than a third, and yet the table falls within seconds. The pendulum could still be caught; but
# the table acts on a state that is past.
#
# ## A wrong zero
#
# The encoder's zero is set by hand, and is wrong by a part of a degree. The table balances at the wrong angle, and there the pendulum falls a little all the time: the flange has to accelerate after it
# with $g \tan\beta$.

# %%
zeros = np.radians([0.0, 0.25, 0.5, 0.75, 1.0])
displaced = [clean, *(trials(twin(zero_offset=float(zero))) for zero in zeros[1:])]
draw(np.degrees(zeros), displaced, "error of the zero [deg]")

# %% [markdown]
# **Exercise 2.** From rest in the middle, after which time is a flange that accelerates with $g \tan\beta$ at
# the end of the track, 0.22 m away, for $\beta$ = 0.75 degrees?

# %% tags=["exercise"]
at_the_end = ...  # [s]

# %%
check(
    2,
    at_the_end,
    lambda t: abs(t - np.sqrt(0.44 / (9.81 * np.tan(np.radians(0.75))))) < 0.02,
    "x = a t² / 2, with a = g tan(beta).",
)

# %% [markdown]
# How do these trials end, and when? If you are right, on the track, after about that time.

# %%
summary = displaced[3].summary()
print(f"zero error of {np.degrees(zeros[3]):g}°: {summary.outcomes}, median {summary.median:.2f} s")

# %% [markdown]
# ## Dry friction
#
# A pivot with dry friction holds a pendulum that is nearly upright, and lets it go suddenly. Make a guess before you
# run the cell: how much of it does this table bear?

# %%
frictions = (0.0, 0.1, 0.5, 2.0)
rubbing = [clean, *(trials(twin(coulomb=friction)) for friction in frictions[1:])]
draw(frictions, rubbing, "dry friction over inertia [1/s²]")

# %% [markdown]
# A suspected cause is not a cause until it is measured.

# %% [markdown]
# ## Everything else
#
# The other effects of the nominal twin, each alone on the clean one.

# %%
real = dict(nominal.settings)
alone = {
    effect: trials(twin(**{number: real[number] for number in numbers}))
    for effect, numbers in EFFECTS.items()
}
seconds = {effect: np.mean(results.survival) for effect, results in alone.items()}
figure, axes = plt.subplots(figsize=(7, 3.4))
axes.barh(list(seconds), list(seconds.values()))
axes.invert_yaxis()
axes.set(xlabel="mean survival with this effect alone [s]")
plt.show()

# %% [markdown]
# **Exercise 3.** Which effect alone costs most? Compute its name from `seconds`.

# %% tags=["exercise"]
worst = ...

# %%
check(
    3,
    worst,
    lambda name: name == min(seconds, key=seconds.get),
    "The key of seconds with the smallest value.",
)

# %% [markdown]
# Some bars are shorter by chance. Trial i starts alike in each world, so that two worlds are compared trial by trial:
# `difference` has the seconds that each trial gained, and `differs` tells whether the 95 % interval of their mean
# excludes zero.


# %%
def difference(results):
    """Return by how much longer each trial survived than on the clean twin [s]."""
    return np.subtract(results.survival, clean.survival)


def differs(seconds):
    """Return whether a mean difference is certain."""
    middle, half = mean(seconds)
    return abs(middle) > half


for effect, results in alone.items():
    print(f"{effect:24} {text(difference(results))}")

# %% [markdown]
# **Exercise 4.** Make the set of the names of all effects whose difference to `clean` is certain.

# %% tags=["exercise"]
certain = ...

# %%
check(
    4,
    certain,
    lambda names: set(names) == {name for name in alone if differs(difference(alone[name]))},
    "A set comprehension over alone, with differs(difference(alone[name])).",
)

# %% [markdown]
# All of them together:

# %%
print(f"on {nominal.name}", text(trials(nominal).survival))

# %%
run = eq.simulate_run(table, world=nominal, seed=1, duration=10.0)
run
