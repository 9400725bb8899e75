"""Trials in CoppeliaSim, the successor of the paper's V-REP: worlds `coppeliasim://HOST:PORT`."""
