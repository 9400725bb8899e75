"""A defective plug-in is one message that names its entry point, and disturbs no other."""

from importlib.metadata import EntryPoint

import pytest

from equipoise.errors import InputError
from equipoise.model.worlds import TwinSettings, read_world
from equipoise.rig import plugins
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import emulated_rig, open_robot
from equipoise.rig.plugins import RobotPlugin, robot_plugin
from tests.rig.in_process import PENDULUM


def half(*_):
    """A driver that can only be connected and closed."""
    return type("Half", (), {"joints": 7, "connect": print, "close": print})()


DEFECTS = {
    "no_such_module:PLUGIN": "No module named 'no_such_module'",
    "defective:NOTHING": "no attribute 'NOTHING'",
    "defective:A_DICT": "is a dict, expected a RobotPlugin",
    "defective:HALF": "Half, is no Robot, without measured, replies, send, start, stop",
    "defective:NO_ARGUMENTS": "raised TypeError",
    "defective:EMPTY": "has no open",
    "wrong_type": "open: Input should be callable, got 'guest'",
    "wrong_unit": "servo.cycle: Input should be less than or equal to 0.01, got 2",
    "wrong_name": "servo.transprot: there is no such field",
    "wrong_share": "link_share: Input should be less than or equal to 1, got 4",
}
"""Values of entry points, and words of their messages."""
FILES = {
    "defective": "from tests.rig.test_plugins import *\nA_DICT = {}\n"
    "HALF = RobotPlugin(open=half)\n"
    "NO_ARGUMENTS = RobotPlugin(open=lambda: None)\nEMPTY = RobotPlugin()\n",
    "wrong_type": "RobotPlugin(open='guest')",
    "wrong_unit": "RobotPlugin(servo={'cycle': 2})",
    "wrong_name": "RobotPlugin(servo={'transprot': 0.004})",
    "wrong_share": "RobotPlugin(link_share=4)",
}


@pytest.mark.parametrize("value", DEFECTS)
def test_a_defect_is_one_message_and_the_other_robots_work(value, tmp_path, monkeypatch):
    for name, text in FILES.items():
        text = "from equipoise.rig.plugins import RobotPlugin\n" + text
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    known = plugins.entry_points
    entry = EntryPoint("broken", value, "equipoise.robots")
    monkeypatch.setattr(plugins, "entry_points", lambda group: [*known(group=group), entry])
    with pytest.raises(InputError) as caught:
        open_robot("broken://host", VirtualClock())
    said = str(caught.value)
    assert said.startswith(f"the plug-in broken = {value!r}")
    assert DEFECTS[value] in said
    assert "\n" not in said
    assert open_robot("kst://host", VirtualClock()).joints == 7
    with pytest.raises(InputError, match="'other' is no known address; .* broken:, .*kst:"):
        robot_plugin("other")
    with pytest.raises(InputError, match="the plug-in broken"):
        emulated_rig(read_world("twin:nominal"), RigSettings(), PENDULUM, robot="broken")


def test_the_numbers_of_a_servo_are_in_si_units():
    servo = RobotPlugin(servo={"cycle": 0.002}).servo
    assert servo.model_dump(exclude_unset=True) == {"cycle": 0.002}
    assert TwinSettings().cycle == 0.001
