"""A measurement becomes a command: boxes, policy, closed-loop inverse kinematics, yardsticks."""
