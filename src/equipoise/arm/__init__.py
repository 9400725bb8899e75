"""Serial arms: their numbers, and kinematics compiled from them."""
