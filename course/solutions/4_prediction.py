"""Solutions of the fourth notebook, one after another."""


# %%
def predicted(phi, phi_dot, w, T):
    """Return phi and phi_dot after the time T, without a push."""
    c, s = np.cosh(w * T), np.sinh(w * T)
    return phi * c + phi_dot / w * s, phi * w * s + phi_dot * c


# %%
bound = 0.05 ** (1 / 10)

# %%
trials = int(np.ceil(np.log(0.05) / np.log(0.99)))

# %%
allowed = max(n for n in range(count) if eq.lower_bound(count - n, count, 0.95) >= claim)
