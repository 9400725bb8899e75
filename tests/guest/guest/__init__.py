"""A guest of Equipoise: a robot, an algorithm, a reward and a policy."""
