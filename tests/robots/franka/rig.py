"""The FR3 of the tests, from the URDF that `franky-sim` brings."""

from pathlib import Path

from equipoise.model.arms.urdf import read_urdf


def urdf():
    """Return the path of the URDF."""
    import franky_sim

    return Path(franky_sim.__file__).parent / "assets" / "fr3.urdf"


def fr3():
    """Return the arm."""
    return read_urdf(urdf(), tip="fr3_link8", held=3)


def serve_franka_sim(pipe, bodies):
    """Serve a rig of `franka-sim` in place of that of `franky-sim`, in a process of its own."""
    from equipoise.robots.franka import franky, lockstep
    from tests.robots.franka.franka_sim_rig import FrankaSimRig

    franky.FrankyRig = FrankaSimRig
    lockstep._serve(pipe, bodies)
