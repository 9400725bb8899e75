# %% [markdown]
# # 2. Q-learning on 270 boxes
#
# The paper's policy is a table. It cuts the state of pendulum and flange into 270 boxes, and knows one of
# eight accelerations for each. The table is learned from trials.

# %%
import matplotlib.pyplot as plt
import numpy as np
from checks import check

import equipoise as eq
from equipoise import paper
from equipoise.learning.episodes import training_config
from equipoise.learning.q_learning import Transition, new_tables, q_learning
from equipoise.model.grid import box_index

# %% [markdown]
# ## Grid
#
# The state is $(x, \dot x, \varphi, \dot\varphi)$: where the flange is, how fast it moves, how much the
# pendulum leans, and how fast it turns.

# %%
print("phi [deg]      ", *paper.PHI_INTERVALS_DEG)
print("phi_dot [deg/s]", *paper.PHI_DOT_INTERVALS_DEG)
print("x [m]          ", *paper.X_INTERVALS)
print("x_dot [m/s]    ", *paper.X_DOT_INTERVALS)
print("accelerations  ", *paper.ACTIONS, "m/s²")

# %% [markdown]
# **Exercise 1.** How many numbers does the table Q hold: one for each box and action?

# %% tags=["exercise"]
numbers = ...

# %%
check(
    1, numbers, lambda n: n == 270 * 8, "Multiply the numbers of intervals, and the eight actions."
)

# %%
policy = eq.shipped_policy()
boxes = policy.grid
print(policy.settings.boxes.count, "boxes")
for lean in (-8, -3, -0.5, 0.5, 3, 8):
    box = box_index(0.0, 0.0, np.radians(lean), 0.0, boxes)
    print(f"lean of {lean:+5.1f} deg: box {box:3}, acceleration {policy.u_of_box[box]:+.1f} m/s²")

# %% [markdown]
# ## One update
#
# After each decision, equation (1) moves one entry of the table towards what was seen:
#
# $$ Q(s, a) \leftarrow (1 - \alpha) Q(s, a) + \alpha \left( r + \gamma \max_{a'} Q(s', a') \right) $$
#
# The reward $r$ is -1 if the pendulum falls, otherwise 0. A value of -1 means *falls now*; a value near
# 0 means *balances for a long time*.

# %%
learning = policy.settings.learning
tables = new_tables(270, 0)
update = training_config(policy.settings, policy.pendulum.k.value, 0).update_params._replace(
    mirrored=False
)
falls = Transition(
    box=17,
    action=3,
    reward=-1.0,
    box_next=18,
    failed=True,
    ended=True,
    epsilon=0.0,
    chance=0.0,
    lane=0,
)
balances = falls._replace(reward=0.0, failed=False, ended=False)
for transition in (falls, balances, balances, falls, balances):
    q_learning(tables, transition, update)
    print("falls:   " if transition.failed else "balances:", f"Q[17, 3] = {tables.Q[17, 3]:+.3f}")

# %% [markdown]
# The learning rate $\alpha$ falls with the visits of an entry, `tables.visits`. At first the newest experience counts
# almost alone; after thousands of visits it hardly changes the value, which is then an average.


# %% [markdown]
# **Exercise 2.** Write equation (1) yourself, for one entry.


# %% tags=["exercise"]
def moved(value, reward, values_next, alpha, gamma):
    """Return the new Q(s, a).

    Args:
        value: Q(s, a) before.
        reward: The reward r.
        values_next: Q(s', a') of all eight actions, shape (8,).
        alpha: Learning rate.
        gamma: Discount.
    """
    return ...


# %%
VALUES = np.array([-0.9, -0.5, -0.2, -0.1, -0.4, -0.6, -0.8, -1.0])
check(
    2,
    moved(-0.5, 0.0, VALUES, 0.1, 0.99),
    lambda new: abs(new - (0.9 * -0.5 + 0.1 * 0.99 * -0.1)) < 1e-12,
    "The best next value is the largest of values_next; weigh old and new with 1 - alpha and alpha.",
)

# %% [markdown]
# ## A training
#
# An episode starts near upright and ends with a fall, or after ten seconds. The simulation holds the
# whole arm with its inverse kinematics, and its delay. Three thousand episodes take some seconds.

# %%
settings = eq.resolve("robust", overrides=["learning.episodes=3000", "evaluation.trials=50"])
trained = eq.train(eq.shipped_pendulum(), eq.iiwa(7), settings, seed=5, workers=2)
trained

# %%
points = trained.learning_curve
figure, axes = plt.subplots(figsize=(8, 3))
axes.plot([p.episodes for p in points], [p.duration for p in points], marker=".")
axes.set(
    xlabel="episodes",
    ylabel="mean length of an episode [s]",
    title="It balances longer while it learns",
)
plt.show()

# %% [markdown]
# **Exercise 3.** After how many episodes did they survive five seconds in the mean for the first time, as long as the
# paper's run on the robot? (`points` holds the points of the curve in order.)

# %% tags=["exercise"]
first = ...

# %%
check(
    3,
    first,
    lambda n: n == next(p.episodes for p in points if p.duration >= 5.0),
    "Go through points, and take the episodes of the first with a duration of 5 s or more.",
)

# %% [markdown]
# ## What it learned
#
# In the middle of the track, with the flange at rest, the table reads as a small picture: lean down,
# rate across. Blue accelerates towards +x, red towards -x. A pendulum that leans to +x or turns there fast
# enough is caught by an acceleration towards +x; lean and rate of opposite signs divide the picture between them.

# %%
shape = trained.settings.boxes.shape
middle = trained.u_of_box.reshape(shape)[:, :, shape[2] // 2, shape[3] // 2]
figure, axes = plt.subplots(figsize=(5, 3.6))
picture = axes.imshow(middle, cmap="RdBu", vmin=-2, vmax=2, aspect="auto")
axes.set(xlabel="phi_dot [deg/s]", ylabel="phi [deg]", title="Acceleration [m/s²]")
axes.set_xticks(range(shape[1]), paper.PHI_DOT_INTERVALS_DEG, rotation=25)
axes.set_yticks(range(shape[0]), paper.PHI_INTERVALS_DEG)
figure.colorbar(picture)
plt.show()

# %% [markdown]
# **Exercise 4.** The task is the same in a mirror: with the opposite state, the opposite acceleration.
# So box $i$ and box $269 - i$ should have opposite actions. For what fraction of the boxes is that so?

# %% tags=["exercise"]
fraction = ...

# %%
check(
    4,
    fraction,
    lambda s: abs(s - np.mean(trained.u_of_box == -trained.u_of_box[::-1])) < 1e-9,
    "Compare trained.u_of_box with its negative in reverse order, u[::-1].",
)

# %% [markdown]
# ## How long it survives
#
# An evaluation runs new trials, which start as after a release by hand, and the baselines on the same trials.

# %%
evaluation = eq.evaluate(trained, seed=1, workers=2)
evaluation
