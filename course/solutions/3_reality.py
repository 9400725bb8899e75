"""Solutions of the third notebook, one after another."""

# %%
growth = np.exp(np.sqrt(70.2) * 0.03)

# %%
at_the_end = np.sqrt(2 * 0.22 / (9.81 * np.tan(np.radians(0.75))))

# %%
worst = min(seconds, key=seconds.get)

# %%
certain = {name for name in alone if differs(difference(alone[name]))}
