"""A linear policy."""


class Policy:
    """State feedback."""

    def reset(self):
        """Count the ticks from zero."""
        self.ticks = 0

    def act(self, observation):
        """Return u [m/s^2]."""
        self.ticks += 1
        x, x_dot, phi, phi_dot = observation
        return 1.2 * x + 1.8 * x_dot + 24.0 * phi + 3.0 * phi_dot
