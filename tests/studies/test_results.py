"""The verdict: five lines that say what happened, no more and no less."""

import pytest

from equipoise.studies.results import percent, plus_minus, verdict
from tests.report import made_up


def test_it_has_five_lines_of_one_sentence_or_two():
    for quick in (False, True):
        lines = verdict(made_up.results(quick=quick))
        assert len(lines) == 5
        assert all(line.endswith(".") and "\n" not in line for line in lines)


def test_the_trials_stand_beside_the_papers_run_with_their_interval():
    line = verdict(made_up.results())[0]
    # Clopper-Pearson for 18 of 20, from any table: 68.3 to 98.8 %.
    assert "60 s in 18 of 20 simulated trials (90 %; 95 % interval 68.3 % to 98.8 %)" in line
    assert "), 2 left the track; the paper" in line
    assert "the paper's stood 5 s on the real arm, once" in line


def test_a_perfect_score_is_not_called_certain():
    line = verdict(made_up.results(falls=()))[0]
    # The lower end for 20 of 20 is 0.025^(1/20) = 83.2 %.
    assert "20 of 20 simulated trials (100 %; 95 % interval 83.2 % to 100 %), none failed" in line


def test_the_yardsticks_are_named_with_what_they_did():
    line = verdict(made_up.results())[1]
    assert "LQR 100 % (median 60 s), random 0 % (median 0.55 s)" in line


def test_a_run_that_fell_is_said_to_have_fallen():
    assert "stood all 60 s" in verdict(made_up.results())[2]
    fell = verdict(made_up.results(lasted=20.0, cause="track"))[2]
    assert "left the track after 20 s of 60 s" in fell
    assert "stood all" not in fell


def test_the_room_that_the_run_used_is_told():
    assert "|x| up to 0.12 of 0.22 m and |phi| up to 2.9 of 11 deg" in verdict(made_up.results())[2]


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
    assert "neither a robot nor a digital twin" in line
    assert verdict(made_up.results(quick=True))[4].startswith("A quick look")


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
