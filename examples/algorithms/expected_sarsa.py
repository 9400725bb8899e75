r"""Expected SARSA (van Seijen et al. 2009): value of the followed policy, exploration included.

.. math:: Q(s, a) = (1 - \alpha) Q(s, a) + \alpha (r + \gamma \, E[Q(s', a')])

with a' the best action, or with probability epsilon a random one::

    cd examples/algorithms && equipoise train --algorithm expected_sarsa:algorithm
"""

from equipoise.learning.q_learning import (
    Algorithm,
    Tables,
    Transition,
    UpdateParams,
    best_value,
    move_towards,
)


def update(tables: Tables, transition: Transition, params: UpdateParams) -> None:
    """Move Q(s, a) towards r + gamma E[Q(s', a')]."""
    target = transition.reward
    if not transition.failed:
        values, epsilon = tables.Q[transition.box_next], transition.epsilon
        greedy = best_value(tables.Q, transition.box_next)
        target += params.gamma * (epsilon * values.mean() + (1.0 - epsilon) * greedy)
    move_towards(tables, transition.box, transition.action, target, params)


algorithm = Algorithm(update)
