"""Reproduction of the paper: the whole pipeline in one call, and the folder that it leaves."""
