"""A reward for standing in the middle of the track."""


def middle(state, u, next_state, failed):
    """Return -1 for a failure, otherwise a small cost of the displacement."""
    return -1.0 if failed else -0.2 * next_state.x**2
