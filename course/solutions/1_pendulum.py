"""Solutions of the first notebook, one after another."""

# %%
w2 = (2 * pi / 0.75) ** 2


# %%
def holds(seed):
    """Return whether the interval of w2 from one noisy swing holds the truth."""
    swing = eq.simulate_swing(
        pendulum,
        theta0=radians(40.0),
        duration=4.0,
        rate_hz=500.0,
        counts_per_rev=8192,
        noise=0.002,
        seed=seed,
    )
    low, high = eq.identify(swing).w2.interval
    return low <= 64.0 <= high


# %%
doubled_after = np.log(2) / sqrt(64.0)

# %%
length = 3 * g / (2 * 64.0)
