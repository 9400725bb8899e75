"""Worlds: their names, their numbers as published, and what is refused."""

from math import radians

import pytest

from equipoise import Estimate, Pendulum, PendulumParameters
from equipoise.errors import SettingsError
from equipoise.model.worlds import TwinSettings, pendulum_on, read_world

VISCOUS = Pendulum.assumed(70.2, 0.15)
COULOMB = Estimate.normal(1.957, 0.08, "identified")
FRICTION = {"coulomb": COULOMB, "drag": Estimate.normal(0.02, 0.001, "identified")}
DRY = Pendulum.assumed(120.0, 0.23).model_copy(update=FRICTION)


def test_the_harsh_set_has_the_numbers_that_the_documents_state():
    world = read_world("twin:harsh").settings
    assert (world.transport, world.counts_per_rev) == (0.030, 4096)
    assert (world.coulomb, world.drag, world.assumed_coulomb) == (None, None, 0.3)
    assert world.zero_error == pytest.approx(radians(0.4))
    assert (world.inertia_sigma, world.friction_sigma) == (0.04, 0.4)
    swings = pendulum_on(VISCOUS, world)
    assert (swings.w2, swings.coulomb) == (VISCOUS.w2.value, 0.3)


def test_what_a_trial_varies_varies_the_pendulums_own_friction_and_not_the_worlds():
    heavy = PendulumParameters(w2=60.0, k=6.0, c=0.1, coulomb=1.0, drag=0.01)
    nominal, sticky = TwinSettings(), TwinSettings(coulomb=0.1, drag=0.0)
    assert pendulum_on(DRY, nominal, heavy) == heavy
    assert pendulum_on(DRY, sticky, heavy) == heavy._replace(coulomb=0.1, drag=0.0)


def test_a_file_holds_differences_to_nominal_and_keeps_its_own_name(tmp_path):
    file = tmp_path / "nominal.toml"
    file.write_text("transport = 0.02\nzero_offset = 0.0087\n")
    world = read_world(f"twin:{file}")
    nominal = read_world("twin:nominal").settings
    assert world.settings == nominal.model_copy(update={"transport": 0.02, "zero_offset": 0.0087})
    assert world.name == f"twin:{file}"


@pytest.mark.parametrize("text", ["transport = -1", "transprot = 0.1", "transport = "])
def test_a_file_with_a_mistake_is_refused(tmp_path, text):
    (tmp_path / "w.toml").write_text(text)
    with pytest.raises(SettingsError):
        read_world(f"twin:{tmp_path / 'w.toml'}")


@pytest.mark.parametrize("name", ["nominal", "twin:nominel", "robot", "twin:"])
def test_an_unknown_world_is_refused_with_those_that_there_are(name):
    with pytest.raises(SettingsError, match="nominal"):
        read_world(name)
