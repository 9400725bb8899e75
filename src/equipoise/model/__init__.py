"""A command becomes a measurement: pendulum, arms, encoder."""
