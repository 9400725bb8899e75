"""Worlds: their names, their numbers as published, and what is refused."""

from math import radians

import pytest

from equipoise.errors import SettingsError
from equipoise.model.worlds import NEWEST, SETS, TwinSettings, read_world


@pytest.mark.parametrize(
    ("name", "transport", "counts", "coulomb", "zero_deg", "inertia", "friction"),
    [
        ("twin:nominal", 0.010, 8192, 0.1, 0.2, 0.02, 0.2),
        ("twin:harsh", 0.030, 4096, 0.3, 0.4, 0.04, 0.4),
    ],
)
def test_the_named_sets_have_the_numbers_that_the_documents_state(
    name, transport, counts, coulomb, zero_deg, inertia, friction
):
    world = read_world(name).settings
    assert (world.transport, world.counts_per_rev, world.coulomb) == (transport, counts, coulomb)
    assert world.zero_error == pytest.approx(radians(zero_deg))
    assert (world.inertia_sigma, world.friction_sigma) == (inertia, friction)
    assert (world.lag, world.cycle, world.inner, world.pivot_outward) == (8e-3, 1, "velocity", 0.13)


@pytest.mark.parametrize("short", NEWEST)
def test_a_name_stands_for_its_newest_version_which_has_a_name_of_its_own(short):
    assert read_world(f"twin:{short}") == read_world(f"twin:{NEWEST[short]}")
    assert read_world(f"twin:{short}").name == f"twin:{NEWEST[short]}"


@pytest.mark.parametrize("short", NEWEST)
def test_a_set_without_guards_stays_as_it_was_published(short):
    before, now = (read_world(f"twin:{short}-{version}").settings for version in (1, 2))
    assert now == before.model_copy(update={"guards": True})
    assert not before.guards
    # Digests of what was found there do not know of guards.
    assert not {"guards", "t1"} & set(before.model_dump())
    assert now.model_dump()["guards"] is True
    for settings in (before, now):
        assert TwinSettings.model_validate_json(settings.model_dump_json()) == settings


def test_each_set_can_be_told_from_the_others():
    assert len({read_world(f"twin:{name}").settings.model_dump_json() for name in SETS}) == len(
        SETS
    )


def test_every_number_says_what_it_is():
    for name, field in TwinSettings.model_fields.items():
        assert field.description, name


def test_a_file_holds_differences_to_nominal_and_keeps_its_own_name(tmp_path):
    file = tmp_path / "nominal-1.toml"
    file.write_text("transport = 0.02\nzero_offset = 0.0087\n")
    world = read_world(f"twin:{file}")
    assert world.settings == TwinSettings(transport=0.02, zero_offset=0.0087, guards=True)
    assert world.name == f"twin:{file}"


@pytest.mark.parametrize(
    ("text", "saying"),
    [
        ("transport = -1", "transport"),
        ("transprot = 0.1", "transprot"),
        ('inner = "spring"', "inner"),
        ("transport = ", "not valid TOML"),
    ],
)
def test_a_file_with_a_mistake_is_refused_by_name(tmp_path, text, saying):
    (tmp_path / "w.toml").write_text(text)
    with pytest.raises(SettingsError, match=saying):
        read_world(f"twin:{tmp_path / 'w.toml'}")


@pytest.mark.parametrize("name", ["nominal", "twin:nominel", "robot", "twin:"])
def test_an_unknown_world_is_refused_with_those_that_there_are(name):
    with pytest.raises(SettingsError, match="nominal"):
        read_world(name)
