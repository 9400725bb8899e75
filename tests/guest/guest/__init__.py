"""A guest of Equipoise: a robot that sets the pace."""
