"""Studies of policies, runs and rigs."""
