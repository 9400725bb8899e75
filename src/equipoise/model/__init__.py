"""Models of the plant: pendulum, arms, actuator, encoder."""
