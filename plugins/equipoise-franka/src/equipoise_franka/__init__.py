"""Franka Research 3 behind its Franka Control Interface, in velocity mode."""
