"""Wrong arguments of public functions: one sentence, before any work."""

from pathlib import Path

import numpy as np
import pytest

import equipoise as eq
from equipoise.errors import InputError

WRONG = (object(), float("nan"), float("inf"), -1, [], {"a": 1}, np.zeros(3), b"x", "missing.json")
"""Values that no argument of the table takes."""
TASK = ("pendulum", "arm", "actuator", "settings")
NUMBERS = ("seed", "workers")
ARGUMENTS = {
    eq.train: (*TASK, *NUMBERS, "world", "show"),
    eq.train_to_target: (*TASK, *NUMBERS, "target", "attempts", "world"),
    eq.evaluate: ("policy", "settings", "actuator", *NUMBERS, "world", "with_baselines", "done"),
    eq.simulate_run: ("policy", "settings", "actuator", "seed", "duration", "world"),
    eq.excite: ("arm", "pendulum", "world", "seed", "duration"),
    eq.load_policy: ("name", "pendulum", "arm", "settings"),
    eq.identify: ("trajectory",),
    eq.identify_run: ("run",),
    eq.iiwa: ("size",),
    eq.read_world: ("name",),
    eq.read_urdf: ("path",),
    eq.read_swing: ("path",),
}


@pytest.mark.parametrize(
    ("function", "name"),
    [(function, name) for function, names in ARGUMENTS.items() for name in names],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_a_wrong_argument_gives_one_sentence(function, name):
    for value in WRONG:
        with pytest.raises(InputError) as refusal:
            function(**{name: value})
        assert "\n" not in str(refusal.value)
        assert len(str(refusal.value)) < 300


def test_names_and_files_stand_for_values():
    eq.shipped_pendulum().save("p.json")
    eq.shipped_policy().save("policy.json")
    assert eq.iiwa("iiwa14") == eq.iiwa(14)
    bound = eq.bind_policy(lambda _: 0.0, pendulum="p.json", arm="iiwa14", actuator="ideal")
    assert bound.arm == eq.iiwa(14)
    assert bound.pendulum == eq.shipped_pendulum()
    run = {"world": "ideal", "duration": 0.05}
    by_name = eq.simulate_run(Path("policy.json"), **run)
    assert by_name.digest == eq.simulate_run(eq.shipped_policy(), **run).digest
    assert eq.simulate_run(lambda observation: 1.0, **run).ticks.u.tolist() == [1.0] * 5


def test_an_argument_that_is_given_by_position_is_named():
    with pytest.raises(InputError, match="^settings is 5; expected .* instance of Settings$"):
        eq.evaluate("lqr", 5)
    with pytest.raises(TypeError, match="bogus"):
        eq.evaluate(bogus=1)
