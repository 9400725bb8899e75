"""Settings: which choice wins, what is refused, and that every one is explained."""

from math import radians

import pytest

from equipoise import paper
from equipoise import settings as module
from equipoise.artefacts import Value
from equipoise.errors import SettingsError
from equipoise.settings import RECIPES, Settings, describe_recipe, resolve

CLASSES = [
    item for item in vars(module).values() if isinstance(item, type) and issubclass(item, Value)
]
SECTIONS = [
    (section, field.annotation)
    for section, field in Settings.model_fields.items()
    if isinstance(field.annotation, type)
]
NAMES = [f"{section}.{name}" for section, kind in SECTIONS for name in kind.model_fields]


def toml(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refusal(*overrides, file=None, recipe="robust"):
    """Return the sentence with which settings are refused."""
    with pytest.raises(SettingsError) as refused:
        resolve(recipe, file, overrides)
    message = str(refused.value)
    assert "pydantic" not in message
    return message


def value(settings, name):
    section, key = name.split(".")
    return getattr(getattr(settings, section), key)


# Which choice wins


def test_without_anything_said_the_defaults_hold():
    assert resolve() == Settings()
    assert resolve("robust") == Settings()


def test_a_file_wins_over_a_recipe_over_the_defaults_and_a_single_setting_over_all(tmp_path):
    file = toml(tmp_path, "[learning]\nstart_phi = 0.01\n")
    single = ["learning.start_phi=0.02"]
    default, of_recipe = Settings().learning.start_phi, RECIPES["paper"]["learning.start_phi"]
    assert len({default, of_recipe, 0.01, 0.02}) == 4
    assert resolve("paper").learning.start_phi == of_recipe
    assert resolve("paper", file).learning.start_phi == 0.01
    assert resolve("paper", file, single).learning.start_phi == 0.02
    assert resolve("robust", file).learning.start_phi == 0.01
    assert resolve("robust", None, single).learning.start_phi == 0.02


def test_of_two_single_settings_the_later_wins():
    assert resolve(overrides=["clik.K_p=1", "clik.K_p=2"]).clik.K_p == 2.0


def test_what_is_not_said_stays_as_it_was(tmp_path):
    file = toml(tmp_path, "[clik]\nK_p = 100\n[learning]\nmirrored = true\n")
    got = resolve("paper", file, ["plant.linearised=false"])
    changed = {"clik.K_p", "learning.mirrored", "plant.linearised"}
    for name in set(NAMES) - changed:
        assert value(got, name) == value(resolve("paper"), name), name
    assert got.clik.K_p == 100.0
    assert got.learning.mirrored
    assert not got.plant.linearised


def test_resolving_changes_neither_the_defaults_nor_the_recipes():
    before, recipes = Settings().model_dump(), {name: dict(r) for name, r in RECIPES.items()}
    resolve("paper", overrides=["learning.gamma=0.5", "identification.horizons=[0.5]"])
    assert Settings().model_dump() == before
    assert {name: dict(r) for name, r in RECIPES.items()} == recipes


def test_the_paper_recipe_is_the_barest_reading():
    learning = resolve("paper").learning
    # Constant alpha and epsilon, no symmetry, starts near upright, the last table.
    assert (learning.alpha_decay, learning.alpha_minimum) == (0.0, 0.0)
    assert learning.epsilon_until == 0.0
    assert not learning.mirrored
    assert learning.start_x == learning.start_x_dot == learning.start_phi_dot == 0.0
    assert resolve("paper").selection.every == 0
    assert resolve("paper").plant.linearised
    assert learning.episodes == paper.EPISODES


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_recipe_names_settings_that_exist(recipe):
    assert set(RECIPES[recipe]) <= set(NAMES)
    for name, wanted in RECIPES[recipe].items():
        assert value(resolve(recipe), name) == wanted


def test_settings_say_which_recipe_they_are():
    assert describe_recipe(resolve("paper")) == "paper"
    assert describe_recipe(resolve("robust")) == "robust"
    # What a training does not use makes no other recipe.
    assert describe_recipe(resolve("paper", overrides=["evaluation.trials=3"])) == "paper"
    changed = resolve("paper", overrides=["learning.gamma=0.9", "selection.every=20"])
    said = "custom: paper with learning.gamma = 0.9, selection.every = 20"
    assert describe_recipe(changed) == said


def test_settings_come_back_from_their_own_dump():
    settings = resolve("paper", overrides=["learning.start_phi=0.1"])
    assert Settings.model_validate_json(settings.model_dump_json(), strict=True) == settings
    assert Settings.model_validate(settings.model_dump()) == settings


@pytest.mark.parametrize(
    ("override", "wanted"),
    [
        ("learning.gamma=0.5", 0.5),
        ("  learning.gamma =  0.5 ", 0.5),
        ("learning.episodes=20", 20),
        ("learning.episodes=1e4", 10_000),
        ("learning.episodes=10_000", 10_000),
        ("learning.mirrored=false", False),
        ("identification.friction=coulomb", "coulomb"),
        ('identification.friction="coulomb"', "coulomb"),
        ("identification.horizons=[0.1, 0.5]", (0.1, 0.5)),
        ("learning.reward_failure=-10", -10.0),
    ],
)
def test_a_single_setting_is_read_as_its_type(override, wanted):
    got = value(resolve(overrides=[override]), override.split("=")[0].strip())
    assert got == wanted
    assert type(got) is type(wanted)


# What is refused


def test_an_unknown_recipe_is_refused_and_the_known_ones_are_named():
    message = refusal(recipe="papier")
    assert "'papier'" in message
    assert "robust, fine, paper" in message


@pytest.mark.parametrize(
    ("name", "suggestion"),
    [
        ("learning.gama", "gamma"),
        ("lerning.gamma", "learning"),
        ("learning.epsilon", "epsilon_"),
        ("clik.Kp", "K_p"),
        ("evaluation.trial", "trials"),
    ],
)
def test_an_unknown_name_is_refused_with_a_suggestion(tmp_path, name, suggestion):
    section, key = name.split(".")
    for message in (
        refusal(f"{name}=1"),
        refusal(file=toml(tmp_path, f"[{section}]\n{key} = 1\n")),
    ):
        assert f"there is no setting '{name}'; did you mean '{suggestion}" in message


@pytest.mark.parametrize(
    "name", ["gamma", "learning", "", "a.b.c", "learning.gamma.value", "clik."]
)
def test_a_name_that_is_no_setting_is_refused(name):
    assert f"there is no setting {name!r}; " in refusal(f"{name}=1")


def test_an_override_without_a_value_is_refused():
    assert "expected NAME=VALUE" in refusal("learning.gamma")
    assert "learning.gamma" in refusal("learning.gamma=")


@pytest.mark.parametrize(
    "override",
    [
        "learning.gamma=1.0",
        "learning.gamma=0",
        "learning.gamma=nan",
        "learning.gamma=high",
        "learning.gamma=[0.9]",
        "learning.gamma={a = 1}",
        "learning.episodes=0",
        "learning.episodes=2.5",
        "learning.mirrored=maybe",
        "learning.alpha_initial=0",
        "learning.alpha_initial=1.1",
        "learning.epsilon_initial=-0.1",
        "learning.start_x=0.22",
        "clik.K_p=0",
        "clik.K_d=-1",
        "clik.K_p=inf",
        "plant.position_error_sigma=-0.5",
        "plant.delay_spread=-0.001",
        "plant.lag_spread=1",
        "plant.zero_error=-0.1",
        "plant.counts_per_rev=8",
        "plant.counts_per_rev=8192.5",
        "controller.predict=perhaps",
        "controller.margin=-0.001",
        "controller.acceleration_sigma=0",
        "controller.angle_sigma=-1e-4",
        "controller.bias_drift=0",
        "controller.correction=1.1",
        "selection.every=-1",
        "evaluation.trials=0",
        "evaluation.duration=0",
        "evaluation.duration=2001-01-01",
        "identification.friction=greasy",
        "identification.horizons=0.1",
        "identification.g=0",
    ],
)
def test_an_impossible_value_is_refused_with_its_name_and_what_came(override):
    message = refusal(override)
    assert message.startswith(f"setting {override.split('=')[0]}: ")
    assert ", got " in message


@pytest.mark.parametrize(
    "override",
    [
        # Shorter than one step of 0.01 s: no trial at all.
        "evaluation.duration=0.001",
        "learning.episode_duration=0.001",
        "selection.duration=0.001",
        # No failure would be worse than a success.
        "learning.reward_failure=1",
        # Every episode would begin failed.
        "learning.start_phi=0.5",
        # Not shares of a window.
        "identification.horizons=[-0.1, 5]",
    ],
)
def test_a_value_that_makes_no_sense_is_refused(override):
    refusal(override)


@pytest.mark.parametrize("name", ["phi", "phi_dot"])
def test_a_range_of_starts_with_its_ends_reversed_is_refused(name):
    refusal(f"evaluation.{name}_low=0.1", f"evaluation.{name}_high=0.05")


@pytest.mark.parametrize(
    "text",
    [
        "learning",
        "[learning\n",
        "[learning]\ngamma = \n",
        "[learning]\ngamma = 1\ngamma = 2\n",
        b"\xff",
    ],
)
def test_a_file_that_is_not_toml_is_refused_by_name(tmp_path, text):
    message = refusal(file=toml(tmp_path, text))
    assert "mine.toml" in message
    assert "not valid TOML" in message


def test_a_file_that_cannot_be_read_is_refused(tmp_path):
    assert "there is no file" in refusal(file=tmp_path / "mine.toml")
    assert "directory" in refusal(file=tmp_path)


def test_a_setting_outside_a_section_is_refused(tmp_path):
    message = refusal(file=toml(tmp_path, "gamma = 0.9\n"))
    assert "'gamma' stands outside a section" in message
    assert "[learning]" in message


def test_a_wrong_value_in_a_file_is_refused_by_its_name(tmp_path):
    message = refusal(file=toml(tmp_path, '[learning]\ngamma = "high"\n'))
    assert message.startswith("setting learning.gamma: ")
    assert "'high'" in message


def test_an_empty_file_changes_nothing(tmp_path):
    assert resolve("paper", toml(tmp_path, "")) == resolve("paper")


# Every choice is explained


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_every_setting_has_its_docstring(kind):
    for name, field in kind.model_fields.items():
        assert kind is Settings or (field.description or "").strip(), f"{kind.__name__}.{name}"


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_no_setting_can_be_changed_or_added(kind):
    settings = kind()
    for name in kind.model_fields:
        with pytest.raises(ValueError, match="frozen"):
            setattr(settings, name, None)
    with pytest.raises(ValueError, match="unknown"):
        kind(unknown=1)


def test_there_is_a_section_for_each_part_of_the_story():
    assert [section for section, _ in SECTIONS] == list(Settings.model_fields)
    assert len(set(NAMES)) == len(NAMES) > 40


def test_what_the_design_asks_for_is_the_default():
    settings = Settings()
    e, plant = settings.evaluation, settings.plant
    # As a release leaves the pendulum: 1.5 to 2.5 degrees and 8 to 18 degrees per second.
    starts = (e.phi_low, e.phi_high, e.phi_dot_low, e.phi_dot_high)
    assert starts == pytest.approx([radians(a) for a in (1.5, 2.5, 8, 18)], rel=1e-15)
    assert e.duration == 60.0
    # I and b vary by 2 % and 20 %, e by 0.1 mm and 0.02 degrees.
    assert (plant.inertia_sigma, plant.friction_sigma) == (0.02, 0.2)
    assert plant.position_error_sigma == 1e-4
    assert plant.orientation_error_sigma == pytest.approx(radians(0.02), rel=1e-15)
    # The identified delay plus 5 ms; a zero that is wrong by up to 0.3 degrees; a bias estimate.
    assert settings.controller.margin == 0.005
    assert settings.controller.predict
    assert settings.controller.estimate_bias
    assert plant.zero_error == pytest.approx(radians(0.3), rel=1e-15)
    assert settings.clik.K_p == 400.0
    assert settings.clik.K_d == 40.0
    assert settings.learning.episodes == 10_000


# A limited speed


def test_a_given_speed_limit_replaces_that_of_the_settings(tmp_path):
    assert resolve(max_speed=0.23).plant.max_speed == 0.23
    assert resolve().plant.max_speed is None
    file = toml(tmp_path, "[learning]\ngamma = 0.98\n[plant]\nmax_speed = 0.5\n")
    assert resolve(file=file, max_speed=0.23).plant.max_speed == 0.23
    assert resolve(file=file).plant.max_speed == 0.5
    with pytest.raises(SettingsError, match=r"plant\.max_speed"):
        resolve(max_speed=0.0)


DEEP = {
    "lists": "[" * 900,
    "tables": "{a=" * 300,
    "lists over many lines": "[\n" * 10_000,
    "a long integer": "9" * 900,
    "a longer integer": "9" * 5000,
    "a long hexadecimal integer": "0x" + "f" * 900,
    "a long name": "1\n" + ".".join("a" * 400) + " = 1",
    "a longer name": "1\n" + ".".join("a" * 20_000) + " = 1",
    "many lines": "1\n" + "# comment\n" * 7000,
}


@pytest.mark.parametrize("text", DEEP.values(), ids=DEEP)
def test_nesting_and_long_integers_are_refused_in_one_short_sentence(tmp_path, text):
    for message in (
        refusal(file=toml(tmp_path, f"[learning]\ngamma = {text}")),
        refusal(f"learning.gamma={text}"),
        refusal(f"{text}=1"),
    ):
        assert len(message) < 1200
        assert "\n" not in message


def test_more_candidates_than_anybody_screens_are_refused():
    message = refusal("learning.episodes=10_000_000", "selection.every=1")
    assert "selection.every of 1 makes more than 100,000 candidates" in message
    assert "100000000" in refusal(f"learning.episodes={10**30}")
