"""A guest of Equipoise: a robot that sets the pace, a learner, a reward and a policy."""
