"""What `rig.toml` may say, and which addresses are some."""

from dataclasses import replace

import numpy as np
import pytest

from equipoise import read_urdf
from equipoise.errors import InputError, SettingsError
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.config import RigSettings, read_rig
from equipoise.rig.connection import connect
from equipoise.rig.plugins import Session, robot_plugin
from tests.arm.witnesses import ELBOW, ELBOW_HOME
from tests.conftest import written
from tests.rig.test_run import POLICY, request


def test_a_load_is_half_way_to_the_pivot_unless_its_centre_is_given():
    assert RigSettings().load is None
    assert RigSettings(pivot_mm=(-130, 0, 35), load_kg=0.5).load == (0.5, (-0.065, 0.0, 0.0175))
    text = "load_kg = 0.5\nload_mm = [1, 2, 3]\n"
    assert read_rig(written("rig.toml", text)).load == (0.5, (0.001, 0.002, 0.003))
    clock, load = VirtualClock(), RigSettings(load_kg=0.5).load
    with pytest.raises(InputError, match="Sunrise.Workbench"):
        robot_plugin("kst").open("kst://127.0.0.1", Session(clock, clock, load=load))


def test_a_rig_describes_an_arm_from_a_urdf_beside_it():
    written("arm.urdf", ELBOW.read_text())
    home = ", ".join(f"{np.degrees(angle):.4f}" for angle in ELBOW_HOME)
    text = (
        f'arm = "arm.urdf"\ntip = "adapter"\nhome_deg = [{home}]\n'
        "pivot_mm = [10, 20, 130]\nacceleration_deg = 400\nencoder_sign = -1\n"
    )
    rig = read_rig(written("rig.toml", text))
    assert rig.encoder_sign == -1
    arm = rig.described_arm
    expected = read_urdf(ELBOW, tip="adapter", home=ELBOW_HOME)
    assert [joint.xyz for joint in arm.joints] == [joint.xyz for joint in expected.joints]
    assert arm.home == pytest.approx(ELBOW_HOME, abs=1e-6)
    assert arm.pivot == pytest.approx((0.01, 0.02, 0.13))
    assert arm.joints[0].acceleration == pytest.approx(np.radians(400))
    assert arm.joints[0].link == expected.joints[0].link


@pytest.mark.parametrize(
    "text",
    [
        *("counts = 8192", 'arm = "iiwa.urdf"', "encoder_sign = 2", "= 3", "load_kg = true"),
        *("home_deg = [0, 0, 0]", "home_deg = [0, 130, 0, 0, 0, 0, 0]", "counts_per_rev = nan"),
        *("pivot_mm = [-1000, 0, 0]", "load_kg = 0.5\nload_mm = [0, 0, 500]"),
        "torque_fraction = 1e-6",
    ],
)
def test_what_cannot_be_is_refused(text):
    with pytest.raises(SettingsError):
        read_rig(written("rig.toml", text))


@pytest.mark.parametrize(
    ("robot", "encoder"),
    [
        ("kst://host:70000", "serial:///dev/ttyACM0"),
        ("kst://host?port=3", "serial:///dev/ttyACM0"),
        ("kst://host", "serial://"),
        ("http://host", "serial:///dev/ttyACM0"),
        ("kst://host", None),
        ("twin:nominal", "serial:///dev/ttyACM0"),
        ("model", None),
    ],
)
def test_an_address_that_is_none_is_refused(robot, encoder):
    with pytest.raises(InputError):
        connect(replace(request(robot=robot), encoder=encoder))


def test_what_a_rig_says_of_its_limits_becomes_its_rules():
    text = "position_margin_deg = 10\nspeed_fraction = 0.5\ntorque_fraction = 0.2\n"
    file = written("rig.toml", text)

    def safety(rig):
        return replace(request(), settings=rig).parameters(POLICY.actuator)[1]

    usual, strict = safety(RigSettings()), safety(read_rig(file))
    assert np.subtract(strict.limits.lower, usual.limits.lower) == pytest.approx(np.radians(7.0))
    assert np.subtract(usual.limits.upper, strict.limits.upper) == pytest.approx(np.radians(7.0))
    assert np.divide(strict.limits.velocity, usual.limits.velocity) == pytest.approx(0.5)
    assert np.divide(strict.torque, usual.torque) == pytest.approx(2.0)
