r"""Watkins's Q(lambda) (1989), with replacing traces (Singh & Sutton 1996).

Each decision leaves a trace e(s, a) = 1 that fades by gamma lambda with each later decision of its
episode. The error of equation (1),

.. math:: \delta = r + \gamma \max_{a'} Q(s', a') - Q(s, a),

corrects every pair by its trace, Q = Q + alpha e delta, so that a failure reaches the decisions
before the last one at once. An action that is not the best one ends all earlier traces: later
rewards say nothing about the greedy policy::

    cd examples/algorithms && equipoise train --algorithm watkins:algorithm
"""

from equipoise.learning.q_learning import (
    Algorithm,
    Tables,
    Transition,
    UpdateParams,
    best_value,
    learning_rate,
    write_mirrored,
)

TRACE_DECAY = 0.7
"""lambda: fraction of an error that reaches the previous decision [-]."""
MIN_TRACE = 1e-3
"""Smallest trace that is kept [-]; at lambda gamma = 0.69 after 19 decisions."""
EPISODES = 16
"""Number of episodes that run side by side, each with its own traces."""


def update(tables: Tables, transition: Transition, params: UpdateParams) -> None:
    """Correct all pairs that have a trace; after a failure the target is the reward alone."""
    Q, visits, trace = tables.Q, tables.visits, tables.own[transition.lane]
    box, action = transition.box, transition.action
    if Q[box, action] < best_value(Q, box):
        trace[:] = 0.0
    target = transition.reward
    if not transition.failed:
        target += params.gamma * best_value(Q, transition.box_next)
    delta = target - Q[box, action]
    fade = 0.0 if transition.ended else params.gamma * TRACE_DECAY
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


algorithm = Algorithm(update, tables=EPISODES)
