# %% [markdown]
# # 5. Your own algorithm against the table
#
# Q-learning is one rule of many. A rule of your own is a file with one function. Here you write Expected
# SARSA, train it as the built-in ones are trained, and find out, with an interval, whether it is better.

# %%
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from checks import check
from scipy.stats import binomtest, ttest_1samp

import equipoise as eq

# %% [markdown]
# ## The rule
#
# Q-learning believes that the best action will be taken next. But while it learns, it explores: with the
# probability $\epsilon$ the next action is a random one. SARSA takes the action that is really chosen; Expected
# SARSA takes the mean over all of them:
#
# $$ r + \gamma \left( \epsilon \,\overline{Q(s', \cdot)} + (1 - \epsilon) \max_{a'} Q(s', a') \right) $$
#
# **Exercise 1.** Complete the file. `transition` has `reward`, `box`, `box_next`, `action`, `epsilon` and `failed`;
# `params.gamma` is $\gamma$, and `best_value(Q, box)` is the maximum.

# %% tags=["exercise"]
RULE = '''
"""Expected SARSA."""

from equipoise.learning.q_learning import Algorithm, best_value, move_towards


def update(tables, transition, params):
    """Move Q(s, a) towards r + gamma E[Q(s', a')]."""
    target = transition.reward
    if not transition.failed:
        target += ...
    move_towards(tables, transition.box, transition.action, target, params)


algorithm = Algorithm(update)
'''

# %%
if "..." not in RULE:
    Path("my_algorithm.py").write_text(RULE)


def target_of(rule):
    """Return what the rule moves an entry towards, in a small case."""
    seen, names = [], {}
    exec(rule, names)
    names["update"].__globals__["move_towards"] = lambda *arguments: seen.append(arguments[3])
    Q = np.array([[0.0] * 8, [-0.8, -0.1, -0.3, -0.4, -0.2, -0.6, -0.7, -0.9]])
    tables = type("Tables", (), {"Q": Q})
    fields = {"box": 0, "action": 2, "reward": 0.0, "box_next": 1, "failed": False, "epsilon": 0.2}
    params = type("UpdateParams", (), {"gamma": 0.9})
    names["update"](tables, type("Transition", (), fields), params)
    return seen[0]


check(
    1,
    ... if "..." in RULE else target_of(RULE),
    lambda target: abs(target - 0.9 * (0.2 * -0.5 + 0.8 * -0.1)) < 1e-9,
    "params.gamma * (epsilon * mean of Q[box_next] + (1 - epsilon) * best_value(Q, box_next)).",
)

# %% [markdown]
# ## The training
#
# The setting `learning.algorithm` names it, as `MODULE:NAME`. Everything else is the same for all algorithms.
# Until your file is complete, this trains double Q-learning, a relative from examples/algorithms. If you change the file after a training,
# restart the kernel: Python imports a module only once.

# %%
sys.path.append("../examples/algorithms")
mine = "my_algorithm:algorithm" if Path("my_algorithm.py").exists() else "double_q:algorithm"


def trained(algorithm, seed, episodes):
    """Return the last table of a training, whose evaluation is 50 trials of 30 s."""
    settings = eq.resolve(
        "robust",
        overrides=[
            f'learning.algorithm="{algorithm}"',
            f"learning.episodes={episodes}",
            "selection.every=0",
            "evaluation.trials=50",
            "evaluation.duration=30",
        ],
    )
    return eq.train(eq.shipped_pendulum(), eq.iiwa(7), settings, seed=seed, workers=2)


table = trained(mine, seed=0, episodes=3000)
table

# %% [markdown]
# ## The comparison
#
# One training is one toss: another seed may turn a result around. So train each algorithm with several seeds. With
# 3,000 episodes nearly every table survives; after 300 the algorithms still differ, and the question is which one learns
# faster. Seed for seed, both see the same starts and plants in training, and the same trials afterwards.

# %%
seeds = range(10)


def mean_survival(policy):
    """Return the mean survival of a policy in its trials [s]."""
    return np.mean(eq.evaluate(policy, with_baselines=False, workers=2).results.survival)


survival = {
    algorithm: np.array([mean_survival(trained(algorithm, seed, episodes=300)) for seed in seeds])
    for algorithm in ("q_learning", mine)
}
for algorithm, seconds in survival.items():
    low, high = ttest_1samp(seconds, 0.0).confidence_interval()
    print(f"{algorithm:20} {np.mean(seconds):5.1f} s, 95 %: {low:.1f} to {high:.1f}")

# %% [markdown]
# LQR needs no training at all. It runs the same trials, and each trial is a success or a failure:

# %%
lqr = eq.evaluate(eq.load_policy("lqr", settings=table.settings), with_baselines=False, workers=2)
lqr

# %%
_, axes = plt.subplots(figsize=(5, 3.6))
for pair in zip(*survival.values(), strict=True):
    axes.plot((0, 1), pair, color="0.6", marker="o", markerfacecolor="tab:blue")
axes.axhline(np.mean(lqr.results.survival), color="tab:green", linestyle="--")
axes.set_xticks((0, 1), survival)
axes.set(ylabel="mean survival [s]", xlim=(-0.4, 1.4), title="A line for each seed; dashed: LQR")
plt.show()

# %% [markdown]
# Two intervals that overlap say little. Since the seeds are paired, ask for the difference in each pair.
#
# **Exercise 2.** Compute `gains`, by how many seconds your algorithm survived longer than Q-learning, one number for each
# seed.

# %% tags=["exercise"]
gains = ...

# %%
check(
    2,
    gains,
    lambda found: np.allclose(found, survival[mine] - survival["q_learning"]),
    "Subtract the arrays in survival: yours minus that of q_learning.",
)

# %% [markdown]
# If the interval of their mean contains zero, the trainings do not tell which algorithm is faster. The sign test asks
# for less: if both were equally good, each seed would be a toss of a coin, and its p says how surprising the tosses
# are. Below 0.05 one would call one of them better.

# %%
if gains is ...:
    print("solve exercise 2 first")
else:
    low, high = ttest_1samp(gains, 0.0).confidence_interval()
    print(f"gain: {np.mean(gains):+.1f} s, 95 %: {low:+.1f} to {high:+.1f}")
    better, worse = int(np.sum(gains > 0.0)), int(np.sum(gains < 0.0))
    p = binomtest(better, better + worse).pvalue if better + worse else 1.0
    print(f"{better} seeds for yours, {worse} for Q-learning: p = {p:.3f}")

# %% [markdown]
# **Exercise 3.** How many trainings of each would you need at least, for a sign test that can reach p < 0.05? (All of
# them would have to go to the same algorithm.)

# %% tags=["exercise"]
trainings = ...

# %%
check(3, trainings, lambda n: n == 6, "The p of n tosses with the same result is 2 / 2**n.")

# %% [markdown]
# ## Closer to the middle
#
# Where all survive, survival no longer separates the policies. How far from the middle do they go? Here is one run of
# each on the digital twin, with the same start.

# %%
runs = {
    name: eq.simulate_run(policy, world="twin:nominal", duration=20.0, seed=4)
    for name, policy in (("mine", table), ("lqr", eq.load_policy("lqr")))
}
for name, run in runs.items():
    print(f"{name:5} ended: {run.outcome}; x within {1e3 * np.abs(run.ticks.x).max():.0f} mm")
runs["mine"]

# %% [markdown]
# Where to go from here: a reward of your own, other boxes, a network
# ([bring a policy](../docs/how-to/bring-a-policy.md)), all of them in one comparison
# (`experiments/compare.py`), or a real pendulum.
