# %% [markdown]
# # 4. Prediction, and what may be claimed
#
# A delay cannot be removed, but it can be known. Ten seconds of motion tell how the arm responds. Then the
# controller computes the state in which its next command will take effect, and the same kind of table
# balances again. How sure can one be?

# %%
import matplotlib.pyplot as plt
import numpy as np
from checks import check

import equipoise as eq

# %% [markdown]
# ## How the arm responds
#
# `excite` moves the joints of the twin for ten seconds; `identify_run` finds the transport delay and the
# lag of each drive in the log.

# %%
excitation = eq.excite(eq.iiwa(7), "twin:nominal", eq.shipped_pendulum(), seed=3)
actuator = eq.identify_run(excitation)
low, high = actuator.delay.interval
print(f"delay {1e3 * actuator.delay.value:.2f} ms (95 %: {1e3 * low:.2f} to {1e3 * high:.2f})")
print("lags of the joints [ms]:", *(f"{1e3 * lag.value:.1f}" for lag in actuator.lags))
truth = eq.read_world("twin:nominal").settings
print(
    f"true: {1e3 * truth.transport:g} ms of transport, drives with a lag of {1e3 * truth.lag:g} ms"
)

# %% [markdown]
# ## With and without prediction
#
# The shipped table was trained behind such an actuator, with prediction. It was then tested in trials that had no
# part in choosing it:

# %%
policy = eq.shipped_policy()
print(policy.test or "not tested")
policy

# %% [markdown]
# Here it runs with and without the prediction, on twins with more and more delay. The controller always knows the
# delay: its actuator is moved by as much as the twin's.

# %%
nominal = eq.read_world("twin:nominal")


def settings_with(predict):
    """Return the settings of the policy for 20 trials of 30 s, with or without prediction."""
    args = policy.settings
    return args.model_copy(
        update={
            "controller": args.controller.model_copy(update={"predict": predict}),
            "evaluation": args.evaluation.model_copy(update={"trials": 20, "duration": 30.0}),
        }
    )


def survival(delay, predict):
    """Return the mean survival [s] on a twin with a delay [s]."""
    world = nominal._replace(
        name=f"twin:{1e3 * delay:g}ms",
        settings=nominal.settings.model_copy(update={"transport": delay}),
    )
    identified = policy.actuator.delay
    true = identified.value + delay - nominal.settings.transport
    known = policy.actuator.model_copy(
        update={"delay": eq.Estimate.around(max(true, 0.0), 0.0, "assumed")}
    )
    results = eq.evaluate(
        policy, settings_with(predict), world=world, actuator=known, with_baselines=False, workers=2
    ).results
    return float(np.mean(results.survival))


delays = (0.0, 0.005, 0.010, 0.020, 0.030)
with_it = [survival(delay, predict=True) for delay in delays]
without = [survival(delay, predict=False) for delay in delays]
figure, axes = plt.subplots(figsize=(6, 3))
axes.plot(np.multiply(1e3, delays), with_it, marker="o", label="with prediction")
axes.plot(np.multiply(1e3, delays), without, marker="s", label="without")
axes.set(xlabel="transport delay [ms]", ylabel="mean survival [s]", ylim=(0, 32))
axes.legend()
plt.show()


# %% [markdown]
# **Exercise 1.** The heart of a prediction: where will the pendulum be after the time $T$? While nothing
# pushes it, near upright, $\varphi(T) = \varphi \cosh w T + (\dot\varphi / w) \sinh w T$. Write it, with its rate.


# %% tags=["exercise"]
def predicted(phi, phi_dot, w, T):
    """Return phi and phi_dot after the time T, without a push."""
    return ...


# %%
check(
    1,
    predicted(0.02, -0.1, 8.38, 0.03),
    lambda p: np.allclose(
        p,
        (
            0.02 * np.cosh(0.2514) - 0.1 / 8.38 * np.sinh(0.2514),
            0.02 * 8.38 * np.sinh(0.2514) - 0.1 * np.cosh(0.2514),
        ),
        atol=1e-9,
    ),
    "The rate is the derivative: phi w sinh(w T) + phi_dot cosh(w T). Return both.",
)

# %% [markdown]
# ## How many trials?
#
# Ten trials, ten successes. What may be claimed? If the true probability of survival were $p$, ten successes
# in a row would happen with the probability $p^{10}$. Where this is below 5 %, $p$ may be ruled out.

# %%
p = np.linspace(0.5, 1.0, 200)
figure, axes = plt.subplots(figsize=(6, 3))
for n in (10, 50, 299):
    axes.plot(p, p**n, label=f"{n} of {n} survived")
axes.axhline(0.05, color="0.6", linestyle="--")
axes.set(xlabel="true probability of survival", ylabel="chance of what was seen")
axes.legend()
plt.show()

# %% [markdown]
# **Exercise 2.** Ten of ten survived. What is the largest probability that is still ruled out, with 95 % confidence?

# %% tags=["exercise"]
bound = ...

# %%
check(2, bound, lambda b: abs(b - 0.05**0.1) < 1e-3, "Solve p**10 = 0.05 for p.")

# %% [markdown]
# **Exercise 3.** How many trials without a failure does a claim of 99 % need?

# %% tags=["exercise"]
trials = ...

# %%
check(3, trials, lambda n: n == 299, "The smallest whole number n with 0.99**n <= 0.05.")

# %% [markdown]
# ## A claim
#
# A claim says of a policy: in this world, a trial of this length survives with at least this probability. `trials_for` gives
# the number of trials, which has to be fixed in advance. The claim is granted if the exact lower bound of the
# probability reaches it.

# %%
claim, count = 0.97, eq.trials_for(0.97)
length = {"trials": count, "duration": 10.0}


def decide(candidate):
    """Test the claim about a policy, and print the verdict."""
    evaluation = candidate.settings.evaluation.model_copy(update=length)
    settings = candidate.settings.model_copy(update={"evaluation": evaluation})
    found = eq.evaluate(candidate, settings, world="twin:nominal", with_baselines=False, workers=2)
    failed = count - found.results.summary().survived
    bound = eq.lower_bound(count - failed, count, 0.95)
    print(
        f"{'granted' if bound >= claim else 'refused'}: {failed} of {count} trials failed; bound {bound:.4f}"
    )
    return found


decide(policy)

# %% [markdown]
# The same table without its prediction:

# %%
decide(policy.model_copy(update={"settings": settings_with(False)}))

# %% [markdown]
# **Exercise 4.** One failure is no refusal yet: how many failures may these trials have?

# %% tags=["exercise"]
allowed = ...

# %%
check(
    4,
    allowed,
    lambda n: (
        eq.lower_bound(count - n, count, 0.95) >= claim > eq.lower_bound(count - n - 1, count, 0.95)
    ),
    "Count up while lower_bound(count - n, count, 0.95) reaches the claim.",
)

# %% [markdown]
# What a granted claim says: a policy that survives less often than claimed would be refused, but for one time
# in twenty. What it does not say: anything about another world, a longer trial, or a robot whose servo differs
# from the twin's. And of many policies that are tested, some pass by chance.
