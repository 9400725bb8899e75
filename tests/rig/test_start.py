"""From the checklist to the balance with a hand at the pendulum, on the emulated rig."""

from collections import Counter

import pytest

from tests.rig.started import FAULTS, start, verdict

pytestmark = pytest.mark.compiled_only  # the twin takes minutes otherwise

BRIEF = 0.1
"""Nothing of the balance is looked at [s]."""


@pytest.mark.parametrize(
    ("seeds", "clumsy"),
    [
        (range(1), 0.25),
        pytest.param(range(1000, 1200), 0.25, marks=pytest.mark.slow),
    ],
)
def test_nothing_starts_before_the_release(seeds, clumsy):
    runs = [start(seed, clumsy=clumsy, duration=BRIEF) for seed in seeds]
    assert not any(run.early for run in runs), runs


@pytest.mark.parametrize(
    "seeds", [range(2, 3), pytest.param(range(2000, 2200), marks=pytest.mark.slow)]
)
def test_a_clean_release_is_caught_in_time(seeds):
    runs = [start(seed, duration=BRIEF) for seed in seeds]
    assert not any(run.early or run.clumsy for run in runs)
    in_time = sum(abs(run.grown_deg) < 5.0 for run in runs)
    assert in_time >= 0.99 * len(runs), [run for run in runs if not abs(run.grown_deg) < 5.0]


@pytest.mark.slow
def test_what_was_let_go_then_stands():
    runs = [start(seed) for seed in range(2000, 2020)]
    assert [run.outcome for run in runs] == ["lasted"] * len(runs)


@pytest.mark.parametrize(
    ("kind", "seeds"),
    # tests/control/test_self_test.py has every kind on cheap signals.
    [(kind, range(1)) for kind in ("nothing", "sign")]
    + [pytest.param(kind, range(100, 200), marks=pytest.mark.slow) for kind in FAULTS],
)
def test_the_self_test_names_what_is_wrong(kind, seeds):
    named = Counter(verdict(kind, seed) for seed in seeds)
    assert named[FAULTS[kind][0]] >= 0.99 * len(seeds), named
