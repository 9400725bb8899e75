"""The verdict: five lines that say what happened, no more and no less."""

import numpy as np
import pytest

from equipoise.model.worlds import MODEL
from equipoise.outcomes import Outcome
from equipoise.studies.gap_results import CURED, NO_BIAS, NO_PREDICTION, PAPER
from equipoise.studies.results import estimates_zero, observation_differs, truth, verdict
from equipoise.worlds.formatting import percent, plus_minus
from tests.apps.report import made_up
from tests.logs.made_up import changed_table


def test_it_has_five_lines_of_one_sentence_or_two():
    for changes in ({}, {"quick": True}, {"world": MODEL}, {"recipe": "paper"}):
        lines = verdict(made_up.results(**changes))
        assert len(lines) == 5
        assert all(line.endswith(".") and "\n" not in line for line in lines)


def test_the_trials_are_told_with_their_interval_and_their_plant():
    line = verdict(made_up.results())[0]
    assert line.startswith("On the plant of its training")
    # Clopper-Pearson for 18 of 20, from any table: 68.3 to 98.8 %.
    assert "60 s in 18 of 20 trials (90 %; 95 % interval 68.3 % to 98.8 %), 2 left the" in line


def test_a_perfect_score_is_not_called_certain():
    line = verdict(made_up.results(falls=()))[0]
    # The lower end for 20 of 20 is 0.025^(1/20) = 83.2 %.
    assert "20 of 20 trials (100 %; 95 % interval 83.2 % to 100 %), none failed" in line


def test_the_yardsticks_are_named_with_what_they_did():
    assert verdict(made_up.results())[0].endswith("same trials: LQR 100 %; random 0 %.")


def test_the_run_says_where_it_was_and_stands_beside_the_papers():
    line = verdict(made_up.results())[1]
    assert line.startswith("On the digital twin twin:nominal")
    assert "the paper's run on the real arm stood 5 s" in line
    assert "plant of its training once more" in verdict(made_up.results(world=MODEL))[1]


def test_a_run_that_fell_is_said_to_have_fallen():
    assert "stood all 60 s" in verdict(made_up.results())[1]
    fell = verdict(made_up.results(lasted=20.0, cause=Outcome.TRACK))[1]
    assert "left the track after 20 s of 60 s" in fell
    assert "stood all" not in fell


def test_the_room_that_the_run_really_used_is_told():
    found = made_up.results()
    assert "|x| up to 0.12 of 0.22 m and |phi| up to 2.9 of 11 deg" in verdict(found)[1]
    wide = np.full_like(found.run.x, 0.19)
    found = found._replace(run=changed_table(found.run, "truth", x=wide))
    assert "|x| up to 0.19 of 0.22 m" in verdict(found)[1]


def test_the_gap_is_told_in_seconds_on_the_twin_as_it_is():
    found = made_up.results()
    line = verdict(found)[2]
    assert "In 8 trials of 20 s" in line
    for controller in (CURED, NO_PREDICTION, NO_BIAS, PAPER):
        # The transport of `nominal` is 10 ms.
        (point,) = [p for p in found.gap.curve("delay", controller) if p.at == 0.010]
        assert f"{np.mean(point.results.survival):.1f} s" in line


def test_where_there_is_no_study_of_the_gap_the_reason_is_told():
    assert "no digital twin of the iiwa7" in verdict(made_up.results(world=MODEL))[2]
    assert "has none" in verdict(made_up.results(recipe="paper"))[2]


def test_the_truth_is_preferred_to_what_was_seen():
    twin, model = made_up.results().run, made_up.results(world=MODEL).run
    assert truth(twin) is twin.truth
    assert truth(model) is model
    assert observation_differs(twin)
    assert not observation_differs(model)


def test_a_zero_is_estimated_where_there_is_an_encoder():
    assert estimates_zero(made_up.results().run)
    assert not estimates_zero(made_up.results(world=MODEL).run)


def test_the_swing_is_told_with_period_parameters_and_residual():
    line = verdict(made_up.results())[3]
    # 2 pi / sqrt(70.2) = 0.7499 s; the made-up intervals are 0.196 % wide to either side.
    assert "simulated free swing has a period of 0.7499 s" in line
    assert "w2 = 70.20 ± 0.14 1/s^2, c = 0.15000 ± 0.00029 1/s" in line
    assert "0.011 deg RMS" in line
    recorded = verdict(made_up.results(given="mine.csv", warnings=["too short"]))[3]
    assert recorded.startswith("The recorded free swing")
    assert "with 1 warning" in recorded


def test_it_says_that_it_is_simulation_and_whether_it_was_quick():
    line = verdict(made_up.results())[4]
    assert "simulation" in line
    assert "not the authors' robot" in line
    assert "none is from a robot" in verdict(made_up.results(world=MODEL))[4]
    assert verdict(made_up.results(quick=True))[4].startswith("Quick reproduction")


@pytest.mark.parametrize(
    ("share", "text"),
    [(1.0, "100 %"), (0.9996, ">99.9 %"), (0.5, "50 %"), (0.123, "12.3 %"), (0.0, "0 %")],
)
def test_a_share_never_rounds_up_to_certainty(share, text):
    assert percent(share) == text


@pytest.mark.parametrize(
    ("value", "low", "high", "text"),
    [
        (70.2, 70.1, 70.3, "70.20 ± 0.10"),
        (0.15, 0.14, 0.17, "0.150 ± 0.020"),
        (1234.0, 1100.0, 1368.0, "1234 ± 134"),
        (70.2, 70.2, 70.2, "70.2"),
    ],
)
def test_a_value_shows_the_digits_that_its_interval_supports(value, low, high, text):
    assert plus_minus(value, (low, high)) == text
