"""What stands on the bench: the digital twin; later the robot and the encoder."""
