r"""Double Q-learning (van Hasselt 2010): two tables A and B, each valued by the other.

.. math:: A(s, a) = (1 - \alpha) A(s, a) + \alpha (r + \gamma \, B(s', \arg\max_{a'} A(s', a')))

or the same with A and B exchanged, by the toss of a coin. The maximum of noisy values is too large
on average; here the table that chooses a' is not the one that values it. The policy follows their
mean, Q = (A + B) / 2. The algorithm's own table holds half of their difference, D = (A - B) / 2, so
that A = Q + D and B = Q - D. Both tables share the count of visits, and so the learning rate::

    cd examples/algorithms && equipoise train --algorithm double_q:algorithm
"""

from typing import Any

import numba

from equipoise.learning.q_learning import (
    Algorithm,
    Tables,
    Transition,
    UpdateParams,
    learning_rate,
    write_mirrored,
)


@numba.njit
def value_of_best(Q: Any, D: Any, box: int, sign: float) -> float:
    """Return the value that one table gives to the best action of the other in a box.

    Args:
        Q: Mean of both tables.
        D: Half of their difference.
        box: The box.
        sign: 1 where A chooses and B values, -1 where B chooses and A values.
    """
    best = 0
    for i in range(1, Q.shape[1]):
        if Q[box, i] + sign * D[box, i] > Q[box, best] + sign * D[box, best]:
            best = i
    return Q[box, best] - sign * D[box, best]


def update(tables: Tables, transition: Transition, params: UpdateParams) -> None:
    """Move A or B, by the toss of a coin; after a failure the target is the reward alone."""
    Q, D, visits = tables.Q, tables.own[0], tables.visits
    box, action = transition.box, transition.action
    sign = 1.0 if transition.chance < 0.5 else -1.0
    target = transition.reward
    if not transition.failed:
        target += params.gamma * value_of_best(Q, D, transition.box_next, sign)
    # The moved table changes by `change`, their mean and half their difference by half of it.
    value = Q[box, action] + sign * D[box, action]
    change = learning_rate(visits[box, action], params) * (target - value)
    Q[box, action] += 0.5 * change
    D[box, action] += 0.5 * sign * change
    visits[box, action] += 1
    if params.mirrored:
        write_mirrored(Q, box, action)
        write_mirrored(D, box, action)
        write_mirrored(visits, box, action)


algorithm = Algorithm(update, tables=1)
