"""Applications on the public names: console, report, CoppeliaSim."""
