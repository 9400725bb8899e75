"""What is not registered, or is no plugin, is one message; the other robots work."""

import sys
from importlib.metadata import EntryPoint

import pytest

from equipoise import entry_points, read_world, shipped_pendulum
from equipoise.arm.urdf import read_arm
from equipoise.errors import EquipoiseError, InputError
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import emulated_rig
from equipoise.rig.plugins import RobotPlugin, robot_plugin


@pytest.fixture
def register(monkeypatch):
    """Register one entry point in some groups, and hide those of other packages."""

    def register(**values):
        known = entry_points.entry_points

        def found(group):
            points = [one for one in known(group=group) if one.value.startswith("equipoise.")]
            value = values.get(group.removeprefix("equipoise."))
            return points + ([] if value is None else [EntryPoint("own", value, group)])

        monkeypatch.setattr(entry_points, "entry_points", found)

    return register


def test_an_unknown_scheme_names_the_known_ones(register):
    register(robots="equipoise.robots.kst.plugin:PLUGIN")
    with pytest.raises(InputError, match="'other' is no known address; .* kst:, own:, twin:"):
        robot_plugin("other")
    assert robot_plugin("own://host") is robot_plugin("kst")


def test_what_is_no_plugin_is_named(register):
    register(robots="equipoise.paper:__name__")
    with pytest.raises(InputError, match="own://host: .* not a RobotPlugin"):
        robot_plugin("own://host")


@pytest.mark.parametrize(
    ("look", "name"),
    [(read_arm, "fr3"), (read_world, "twin:fr3"), (robot_plugin, "franka://172.16.0.2")],
)
def test_a_package_of_this_project_that_is_not_installed_is_named(register, look, name):
    register()
    with pytest.raises(EquipoiseError, match=r"pip install \./plugins/equipoise-franka"):
        look(name)


def test_a_package_registers_a_twin(register, tmp_path, monkeypatch):
    (tmp_path / "own_twin.py").write_text("TWIN = {'transport': 0.004}")
    monkeypatch.syspath_prepend(tmp_path)
    register(twins="own_twin:TWIN")
    world = read_world("twin:own")
    assert (world.name, world.settings.transport) == ("twin:own", 0.004)


@pytest.mark.compiled_only
@pytest.mark.parametrize(("more", "emulator"), [("", "Board"), (", emulate=emulate", "str")])
def test_a_twin_has_the_emulator_of_its_rigs_sensor(
    register, tmp_path, monkeypatch, more, emulator
):
    (tmp_path / "own_sensor.py").write_text(
        "from equipoise.rig.plugins import Emulated, SensorPlugin\n"
        "def emulate(bench, clock, counts, sign):\n"
        "    return Emulated(None, emulator=f'{counts} {sign}')\n"
        f"PLUGIN = SensorPlugin(open=print{more})\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_sensor", raising=False)
    register(sensors="own_sensor:PLUGIN")
    settings = RigSettings(encoder="own://usb")
    rig = emulated_rig("twin:nominal", settings, shipped_pendulum(), robot="kst")
    assert type(rig.emulated[1].emulator).__name__ == emulator


def test_a_robot_without_an_emulator_says_so():
    with pytest.raises(InputError, match="not emulated"):
        RobotPlugin(open=print).emulate(None, None, 0.0)
