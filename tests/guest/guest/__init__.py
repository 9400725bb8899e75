"""A guest of Equipoise: a robot, a learner, a reward and a policy."""
