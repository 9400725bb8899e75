"""Robots and sensors: each with its driver, codec and emulator."""
