r"""Watkins's Q(lambda) (1989), with replacing traces (Singh & Sutton 1996).

Each decision leaves a trace e(s, a) = 1 that fades by gamma lambda with each later decision of its
episode. The error of equation (1),

.. math:: \delta = r + \gamma \max_{a'} Q(s', a') - Q(s, a),

corrects every pair by its trace, Q = Q + alpha e delta, so that a failure reaches the decisions
before the last one at once. An action that is not the best one ends all traces: later rewards
say nothing about the greedy policy.
"""

from typing import Final

from equipoise.learning.learner import (
    Learner,
    Tables,
    Transition,
    UpdateParams,
    best_value,
    learning_rate,
    write_mirrored,
)
from equipoise.model.elementary import BATCH_SIZE

TRACE_DECAY: Final = 0.7
"""lambda: share of an error that reaches the previous decision [-]."""
MIN_TRACE: Final = 1e-3
"""Smallest trace that is kept [-]; at lambda gamma = 0.69 after 19 decisions."""


def update(tables: Tables, transition: Transition, params: UpdateParams) -> None:
    """Correct all pairs that have a trace; after a failure the target is the reward alone."""
    Q, visits, trace = tables.Q, tables.visits, tables.own[transition.lane]
    box, action = transition.box, transition.action
    target = transition.reward
    greedy = False
    if not transition.failed:
        best = best_value(Q, transition.box_next)
        target += transition.discount * best
        greedy = Q[transition.box_next, transition.action_next] == best
    delta = target - Q[box, action]
    # After an action that was not the best, or at the end of an episode, all traces end.
    fade = 0.0
    if greedy and not transition.ended:
        fade = transition.discount * TRACE_DECAY
    trace[box, action] = 1.0
    for s in range(trace.shape[0]):
        for a in range(trace.shape[1]):
            if trace[s, a] == 0.0:
                continue
            Q[s, a] += learning_rate(visits[s, a], params) * trace[s, a] * delta
            if params.mirrored:
                write_mirrored(Q, s, a)
            trace[s, a] *= fade
            if trace[s, a] < MIN_TRACE:
                trace[s, a] = 0.0
    visits[box, action] += 1
    if params.mirrored:
        write_mirrored(visits, box, action)


learner = Learner(update, tables=BATCH_SIZE, chooses_ahead=True)
