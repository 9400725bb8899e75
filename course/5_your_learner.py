# %% [markdown]
# # 5. Your own learner against the table
#
# Q-learning is one rule of many. A rule of your own is a file with one function. Here you write Expected
# SARSA, train it as the built-in ones are trained, and find out, with an interval, whether it is better.

# %%
from pathlib import Path

import numpy as np
from checks import check
from scipy.stats import binomtest

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
# **Exercise 1.** Complete the file. `transition` has `reward`, `discount` (that is $\gamma$, to the power of the
# steps an action was held), `box`, `box_next`, `action`, `epsilon` and `failed`; `best_value(Q, box)` is the maximum.

# %% tags=["exercise"]
RULE = '''
"""Expected SARSA."""

from equipoise.learning.learner import Learner, best_value, move_towards


def update(tables, transition, params):
    """Move Q(s, a) towards r + gamma E[Q(s', a')]."""
    target = transition.reward
    if not transition.failed:
        target += ...
    move_towards(tables, transition.box, transition.action, target, params)


learner = Learner(update)
'''

# %%
if "..." not in RULE:
    Path("my_learner.py").write_text(RULE)


def target_of(rule):
    """Return what the rule moves an entry towards, in a small case."""
    seen, names = [], {}
    exec(rule, names)
    names["update"].__globals__["move_towards"] = lambda *arguments: seen.append(arguments[3])
    Q = np.array([[0.0] * 8, [-0.8, -0.1, -0.3, -0.4, -0.2, -0.6, -0.7, -0.9]])
    tables = type("Tables", (), {"Q": Q})
    fields = {"box": 0, "action": 2, "reward": 0.0, "discount": 0.9, "box_next": 1, "failed": False}
    names["update"](tables, type("Transition", (), fields | {"epsilon": 0.2}), None)
    return seen[0]


check(
    1,
    ... if "..." in RULE else target_of(RULE),
    lambda target: abs(target - 0.9 * (0.2 * -0.5 + 0.8 * -0.1)) < 1e-9,
    "discount * (epsilon * mean of Q[box_next] + (1 - epsilon) * best_value(Q, box_next)).",
)

# %% [markdown]
# ## The training
#
# The setting `learning.learner` names it, as `MODULE:NAME`. Everything else is the same for all learners.
# Until your file is complete, this trains SARSA, the built-in relative.

# %%
mine = "my_learner:learner" if Path("my_learner.py").exists() else "sarsa"


def trained(learner):
    """Return a policy of a learner: 3,000 episodes, the best of its late tables."""
    settings = eq.resolve(
        "robust",
        overrides=[
            f'learning.learner="{learner}"',
            "learning.episodes=3000",
            "evaluation.trials=100",
            "evaluation.duration=30",
        ],
    )
    return eq.train(eq.shipped_pendulum(), eq.iiwa(7), settings, seed=11, workers=2)


policies = {"q_learning": trained("q_learning"), mine: trained(mine)}
policies[mine]

# %% [markdown]
# ## The comparison
#
# Both run the same trials: the same starts, plants and noise. The twin `harsh` has 20 ms more delay than the
# controller knows of, so that not every trial lasts.

# %%
evaluations = {
    name: eq.evaluate(policy, world="twin:harsh", seed=2, workers=2, with_baselines=(name == mine))
    for name, policy in policies.items()
}
for name, evaluation in evaluations.items():
    summary = evaluation.results.summary()
    low, high = summary.interval
    print(
        f"{name:20} {summary.survived:3} of {summary.trials} lasted (95 %: {low:.2f} to {high:.2f})"
    )
for baseline in evaluations[mine].baselines:
    print(
        f"{baseline.name:20} {baseline.summary().survived:3} of {baseline.summary().trials} lasted"
    )

# %% [markdown]
# Two intervals that overlap say little. Since the trials are the same, compare them pair by pair: count
# those in which only one of the two lasted.

# %%
lasted = {
    name: np.array([cause == "lasted" for cause in evaluation.results.causes])
    for name, evaluation in evaluations.items()
}

# %% [markdown]
# **Exercise 2.** In how many trials did only your learner last, and in how many only Q-learning?

# %% tags=["exercise"]
only_mine = ...
only_q = ...

# %%
check(
    2,
    ... if only_mine is ... or only_q is ... else (only_mine, only_q),
    lambda found: (
        found
        == (
            int(np.sum(lasted[mine] & ~lasted["q_learning"])),
            int(np.sum(lasted["q_learning"] & ~lasted[mine])),
        )
    ),
    "lasted holds arrays of True and False: combine them with & and ~, and sum.",
)

# %% [markdown]
# If both were equally good, each of these trials would be a toss of a coin. The sign test says how
# surprising the tosses are. Below 0.05 one would call one of them better.

# %%
if ... in (only_mine, only_q):
    print("solve exercise 2 first")
elif only_mine + only_q == 0:
    print("no trial tells them apart: ask for longer or harder ones")
else:
    p = binomtest(only_mine, only_mine + only_q).pvalue
    print(f"{only_mine} trials for yours, {only_q} for Q-learning: p = {p:.3f}")

# %% [markdown]
# **Exercise 3.** One training each is one toss as well: another seed may turn the result around. How many
# trainings of each would you need at least, for a sign test over the *trainings* that can reach p < 0.05?
# (All of them would have to go to the same learner.)

# %% tags=["exercise"]
trainings = ...

# %%
check(3, trainings, lambda n: n == 6, "The p of n tosses with the same result is 2 / 2**n.")

# %% [markdown]
# ## And LQR?
#
# The regulator in the table above needed no training at all. How close to the middle do they stay? Film a
# run, or look at the track.

# %%
runs = {
    name: eq.deploy(policy, world="twin:nominal", duration=20.0, seed=4)
    for name, policy in (("mine", policies[mine]), ("lqr", eq.load_policy("lqr")))
}
for name, run in runs.items():
    print(f"{name:5} ended: {run.cause}; x within {1e3 * np.abs(run.x).max():.0f} mm")
runs["mine"]

# %% [markdown]
# Where to go from here: a reward of your own, another partition of the boxes, a network
# ([bring a policy](../docs/how-to/bring-a-policy.md)), all of them in one comparison
# (`equipoise compare`), or a real pendulum.
