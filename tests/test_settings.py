"""Settings: precedence, refusals, and an explanation for each of them."""

import pytest

from equipoise.errors import SettingsError
from equipoise.settings import RECIPES, Settings, resolve
from tests.conftest import written

SECTIONS = {name: type(section) for name, section in Settings()}
NAMES = [f"{section}.{name}" for section, kind in SECTIONS.items() for name in kind.model_fields]


def refusal(*overrides, file=None, recipe="robust"):
    """Return the sentence with which settings are refused."""
    with pytest.raises(SettingsError) as refused:
        resolve(recipe, file, overrides)
    message = str(refused.value)
    assert "pydantic" not in message
    assert "\n" not in message
    assert len(message) < 1200
    return message


def value(settings, name):
    section, key = name.split(".")
    return getattr(getattr(settings, section), key)


def test_a_file_wins_over_a_recipe_over_the_defaults_and_a_single_setting_over_all():
    file = written("mine.toml", "[plant]\norientation_error_sigma = 0.01\n")
    single = ["plant.orientation_error_sigma=0.03", "plant.orientation_error_sigma=0.02"]
    default = Settings().plant.orientation_error_sigma
    of_recipe = RECIPES["paper"]["plant.orientation_error_sigma"]
    assert len({default, of_recipe, 0.01, 0.02}) == 4
    assert resolve() == resolve("robust") == Settings()
    assert resolve("paper").plant.orientation_error_sigma == of_recipe
    assert resolve("paper", file).plant.orientation_error_sigma == 0.01
    assert resolve("paper", file, single).plant.orientation_error_sigma == 0.02
    assert resolve("robust", file).plant.orientation_error_sigma == 0.01
    assert resolve("paper", written("mine.toml", "")) == resolve("paper")


@pytest.mark.parametrize(
    ("override", "wanted"),
    [
        ("  learning.gamma =  0.5 ", 0.5),
        ("learning.episodes=1e4", 10_000),
        ("identification.friction=coulomb", "coulomb"),
        ('identification.friction="coulomb"', "coulomb"),
        ("boxes.x=[-0.1, 0.1]", (-0.1, 0.1)),
    ],
)
def test_a_single_setting_is_read_as_its_type(override, wanted):
    got = value(resolve(overrides=[override]), override.split("=")[0].strip())
    assert got == wanted
    assert type(got) is type(wanted)


def test_a_setting_without_its_section_or_with_a_misspelt_one_is_found():
    for name in ("gamma", "learnin.gamma", "learn.gamma", "learning.gama", "gama"):
        assert "learning.gamma" in refusal(f"{name}=0.9")
    assert "learning.gamma" in refusal(file=written("mine.toml", "gamma = 1"))


@pytest.mark.parametrize("name", ["lerning.gamma", "", "a.b.c"])
def test_an_unknown_name_is_refused(name):
    assert repr(name) in refusal(f"{name}=1")
    if name.count(".") == 1:
        section, key = name.split(".")
        text = f'[{section}]\n"{key}" = 1\n'
        assert repr(name) in refusal(file=written("mine.toml", text))


IMPOSSIBLE = [
    *("learning.gamma=1.0", "learning.gamma=nan", "learning.gamma=true", "learning.episodes=2.5"),
    *("identification.friction=greasy", f"learning.episodes={10**30}"),
]


@pytest.mark.parametrize("override", IMPOSSIBLE)
def test_an_impossible_value_is_refused_with_its_name(override):
    message = refusal(override)
    assert message.startswith(f"setting {override.split('=')[0]}: ")
    assert ", got " in message


DEEP = ["[" * 900, "9" * 5000, "1\n" + ".".join("a" * 400) + " = 1"]


@pytest.mark.parametrize(
    "text",
    [
        *("[learning\n", "gamma = 0.9\n", b"\xff"),
        *(f"[learning]\ngamma = {deep}" for deep in DEEP),
        "# comment\n" * 7000,
    ],
)
def test_an_unreadable_file_is_refused_in_one_sentence(text):
    refusal(file=written("mine.toml", text))


def test_a_missing_file_is_refused(tmp_path):
    refusal(file=tmp_path / "mine.toml")
    refusal(file=tmp_path)
    refusal(recipe="papier")
    refusal("learning.gamma")
    refusal("learning.gamma=")


def test_every_setting_is_explained():
    assert len(NAMES) <= 55
    for kind in SECTIONS.values():
        assert all((field.description or "").strip() for field in kind.model_fields.values())
