"""A run on a rig that several tests read."""

import pytest

from equipoise.control.policy import shipped_policy
from equipoise.model.worlds import pendulum_on, read_world
from equipoise.rig.config import RigSettings, emulated_rig
from equipoise.rig.run import RunRequest, run_virtually


@pytest.fixture(scope="session")
def rig_log(tmp_path_factory):
    """The log of a whole course on an emulated rig: home, self-test, lift, 1.5 s of balancing."""
    path, policy = tmp_path_factory.mktemp("rig") / "run.mcap", shipped_policy()
    settings = RigSettings()
    world = read_world("twin:nominal")
    real = pendulum_on(policy.pendulum, world.settings)
    emulated = emulated_rig(world, settings, real, seed=3, robot="kst")
    request = RunRequest(
        policy=policy,
        actuator=policy.actuator,
        settings=settings,
        robot="kst://emulated",
        encoder="serial:///emulated",
        duration=1.5,
        t1=False,
        dry_run=False,
        seed=3,
    )
    assert run_virtually(request, path, rig=emulated.rig).outcome == "lasted"
    return path


@pytest.fixture
def broken_off(rig_log, tmp_path):
    """The same, cut half a second before its end."""
    path = tmp_path / "cut.mcap"
    whole = rig_log.read_bytes()
    path.write_bytes(whole[: int(0.94 * len(whole))])
    return path
