"""Identification of pendulum and actuator from recordings and logs, and refinement."""
