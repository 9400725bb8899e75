# %% [markdown]
# # 0. A first balance, in five minutes
#
# A robot arm learns to balance a pendulum, in simulation, and you watch its first run. Run the cells from the top with
# Shift+Enter. The first training compiles the code, which takes most of the time.

# %%
# %matplotlib inline
from pathlib import Path

from IPython.display import Image

import equipoise as eq
from equipoise.executors import available_cores
from equipoise.film import write_film
from equipoise.report.figures import policy_picture, survival

# %% [markdown]
# ## Identify
#
# One free swing tells how fast the pendulum falls. This one is simulated; yours is a CSV file for `eq.read_swing`.

# %%
truth = eq.PendulumParameters(w2=64.0, k=6.53, c=0.2)
swing = eq.simulate_swing(truth, theta0=0.7, duration=10.0, rate_hz=500.0, counts_per_rev=8192)
pendulum = eq.identify(swing)
print(pendulum.w2.value, "instead of", truth.w2)

# %% [markdown]
# ## Train
#
# A table of 270 boxes says which of eight accelerations of the hand is the best one. Q-learning fills it by falling often.

# %%
workers = available_cores()
policy = eq.train(pendulum, "iiwa7", workers=workers)
policy_picture(policy)

# %% [markdown]
# ## Evaluate
#
# On the digital twin: with delay, a servo, friction, and an encoder whose zero is wrong.

# %%
settings = eq.resolve(overrides=["evaluation.trials=100", "evaluation.duration=30"])
survival(eq.evaluate(policy, settings, world="twin:nominal", workers=workers))

# %% [markdown]
# ## Watch it

# %%
run = eq.simulate_run(policy, world="twin:nominal", duration=6.0)
write_film(run, Path("run.webp"))
print(run.outcome)
Image(filename="run.webp")

# %% [markdown]
# Change something above, and train again: another arm (`"iiwa14"`), a longer pendulum (a smaller `w2`), or
# `world="ideal"`. The other notebooks of the course explain what you saw.
