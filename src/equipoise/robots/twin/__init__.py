"""The digital twin: arm, cabinet, pendulum and encoder, simulated by a physics engine."""
