"""Solutions of the second notebook, one after another."""

# %%
numbers = 6 * 5 * 3 * 3 * 8


# %%
def moved(value, reward, values_next, alpha, gamma):
    """Return the new Q(s, a)."""
    return (1 - alpha) * value + alpha * (reward + gamma * values_next.max())


# %%
first = next(point.episodes for point in points if point.duration >= 5.0)

# %%
fraction = np.mean(trained.u_of_box == -trained.u_of_box[::-1])
