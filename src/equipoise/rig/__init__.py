"""Devices of a rig: robot, encoder, clock, control loop and digital twin."""
