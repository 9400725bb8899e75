"""The closed loop of controller and plant, and tabular Q-learning in it."""
