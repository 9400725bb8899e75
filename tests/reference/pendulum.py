"""A slow, obvious pendulum: SciPy's adaptive integrator, stopped wherever it turns round.

theta from hanging; theta_ddot = -w2 sin theta - c theta_dot - f sign theta_dot
- d |theta_dot| theta_dot. Written apart from the package's kernel, in the other angle.
"""

import numpy as np
from scipy.integrate import solve_ivp


def swing(time, theta, theta_dot, *, w2, c=0.0, coulomb=0.0, drag=0.0):
    """Return theta and theta_dot at `time`, shape (n,) each, to about 1e-11."""
    time = np.asarray(time, dtype=float)
    state, now, pieces = np.array([theta, theta_dot], dtype=float), time[0], []
    while True:
        direction = np.sign(state[1])
        if direction == 0.0:
            pull = -w2 * np.sin(state[0])
            if abs(pull) <= coulomb:
                rest = time[time >= now]
                pieces.append((rest, np.full(rest.shape, state[0]), np.zeros(rest.shape)))
                break
            direction = np.sign(pull)

        def acceleration(t, y, direction=direction):
            friction = c * y[1] + coulomb * direction + drag * abs(y[1]) * y[1]
            return [y[1], -w2 * np.sin(y[0]) - friction]

        def turns(t, y):
            return y[1]

        turns.terminal, turns.direction = True, -direction
        solution = solve_ivp(
            acceleration, (now, time[-1]), state, method="DOP853", rtol=1e-12, atol=1e-13,
            events=turns if coulomb > 0.0 else None, dense_output=True,
        )  # fmt: skip
        here = time[(time >= now) & (time <= solution.t[-1])]
        if here.size:
            pieces.append((here, *solution.sol(here)))
        if solution.status != 1:
            break
        now, state = solution.t[-1], np.array([solution.y[0, -1], 0.0])
    times = np.concatenate([piece[0] for piece in pieces])
    first = np.searchsorted(times, time)
    return tuple(np.concatenate([piece[i] for piece in pieces])[first] for i in (1, 2))
