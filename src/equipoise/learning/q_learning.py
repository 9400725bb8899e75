r"""Q-learning: the paper's equation (1).

.. math:: Q(s, a) = (1 - \alpha) Q(s, a) + \alpha (r + \gamma \max_{a'} Q(s', a'))

Where an action is held over n steps, r is their discounted sum and gamma^n stands in place of
gamma: the update of a semi-Markov process (Bradtke & Duff 1994), of which equation (1) is the case
n = 1.
"""

from equipoise.learning.learner import (
    Learner,
    Tables,
    Transition,
    UpdateParams,
    best_value,
    move_towards,
)


def update(tables: Tables, transition: Transition, params: UpdateParams) -> None:
    """Apply equation (1); after a failure the target is the reward alone."""
    target = transition.reward
    if not transition.failed:
        target += transition.discount * best_value(tables.Q, transition.box_next)
    move_towards(tables, transition.box, transition.action, target, params)


learner = Learner(update)
