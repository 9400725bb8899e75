"""The encoder on the pendulum's spindle: its protocol, its driver and an emulated board."""
