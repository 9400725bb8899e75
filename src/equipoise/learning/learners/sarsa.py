r"""SARSA (Rummery & Niranjan 1994): value of the followed policy, exploration included.

.. math:: Q(s, a) = (1 - \alpha) Q(s, a) + \alpha (r + \gamma \, Q(s', a'))

with a' the action that is taken in s'.
"""

from equipoise.learning.learner import Learner, Tables, Transition, UpdateParams, move_towards


def update(tables: Tables, transition: Transition, params: UpdateParams) -> None:
    """Move Q(s, a) towards r + gamma Q(s', a'); after a failure the target is the reward alone."""
    target = transition.reward
    if not transition.failed:
        target += transition.discount * tables.Q[transition.box_next, transition.action_next]
    move_towards(tables, transition.box, transition.action, target, params)


learner = Learner(update, chooses_ahead=True)
