"""Solutions of the first notebook, one after another."""

# %%
w2 = (2 * pi / 0.75) ** 2


# %%
def holds(seed):
    """Return whether the interval of w2 from one noisy swing holds the truth."""
    swing = eq.simulate_swing(pendulum, duration=4.0, seed=seed, **RECORDER)
    low, high = eq.identify(swing).w2.interval
    return low <= 64.0 <= high


# %%
friction = "coulomb"

# %%
doubled_after = np.log(2) / sqrt(64.0)
