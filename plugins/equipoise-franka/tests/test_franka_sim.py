"""The driver against a controller of other authors with its own checks, `franka-sim`."""

import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("pylibfranka")
pytest.importorskip("franky_sim")

from equipoise.outcomes import Outcome
from equipoise.rig.connection import connect
from equipoise.rig.run import run_virtually
from equipoise_franka import lockstep
from equipoise_franka import robot as driver

from .test_robot import requested

pytestmark = [pytest.mark.slow, pytest.mark.compiled_only]

PACKAGES = ["franka-sim==1.1.7", "numpy==1.26.4", "mujoco==3.2.7"]
"""`franka-sim`, and what it needs in other versions than this project."""

serve = lockstep._serve


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("franka-sim")
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", folder]
    done = subprocess.run([*install, *PACKAGES], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"franka-sim cannot be installed: {done.stderr.strip()[-200:]}")
    return folder


def serve_franka_sim(pipe, bodies):
    """Serve the rig of `franka-sim` in place of that of `franky-sim`, in its process."""
    from equipoise_franka import franky

    from .franka_sim_rig import FrankaSimRig

    franky.FrankyRig = FrankaSimRig
    serve(pipe, bodies)


@pytest.fixture
def run(packages, monkeypatch):
    def run(seed):
        """Run a policy for 20 s, and return how the run ended."""
        request = requested(20.0, seed)
        with monkeypatch.context() as patch:
            patch.setattr(lockstep, "_serve", serve_franka_sim)
            patch.setenv("EQUIPOISE_CACHE_DIR", str(packages / "cache"))
            patch.syspath_prepend(packages)  # the new process finds them first
            rig = connect(request)
        try:
            return run_virtually(request, None, rig=rig)
        finally:
            rig.bench.close()

    return run


@pytest.mark.parametrize("seed", range(10))
def test_no_command_is_rejected_and_the_pendulum_stays_up(run, seed):
    end = run(seed)
    assert end.outcome is Outcome.SURVIVED, end.reason


def test_a_command_beyond_the_limits_is_rejected(run, monkeypatch):
    random = np.random.default_rng(0)
    monkeypatch.setattr(driver, "limited", lambda v, *_: v + random.uniform(-0.02, 0.02, 7))
    assert "discontinuity" in run(0).reason
