"""Q-learning with a step size of one tenth."""

from equipoise.learning.q_learning import Algorithm, best_value


def update(tables, transition, params):
    """Move Q(s, a) a tenth of the way to r + gamma max Q(s', .)."""
    target = transition.reward
    if not transition.failed:
        target += params.gamma * best_value(tables.Q, transition.box_next)
    box, action = transition.box, transition.action
    tables.Q[box, action] += 0.1 * (target - tables.Q[box, action])
    tables.visits[box, action] += 1


algorithm = Algorithm(update)
