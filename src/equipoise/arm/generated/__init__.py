"""Kinematics generated from the arms of the package: `make generated` writes it again."""
