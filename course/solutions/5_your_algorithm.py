"""Solutions of the fifth notebook, one after another."""

# %%
RULE = '''
"""Expected SARSA."""

from equipoise.learning.q_learning import Algorithm, best_value, move_towards


def update(tables, transition, params):
    """Move Q(s, a) towards r + gamma E[Q(s', a')]."""
    target = transition.reward
    if not transition.failed:
        values, epsilon = tables.Q[transition.box_next], transition.epsilon
        greedy = best_value(tables.Q, transition.box_next)
        target += params.gamma * (epsilon * values.mean() + (1.0 - epsilon) * greedy)
    move_towards(tables, transition.box, transition.action, target, params)


algorithm = Algorithm(update)
'''

# %%
gains = survival[mine] - survival["q_learning"]

# %%
trainings = 6
