"""`equipoise bench`: what it prints; what it measures is tested with the study."""

import pytest

from equipoise.studies import benchmark
from equipoise.studies.benchmark import Benchmark, Rate


@pytest.fixture
def measured(monkeypatch):
    """A measurement that takes no time."""

    def rate(speed):
        return Rate(what="a step", steps_per_second=speed, slowest=0.9 * speed, fastest=speed)

    result = Benchmark(
        rates={"equipoise": rate(2e6), "gymnasium": rate(1e4)},
        missing={"pinocchio": "pin cannot be imported"},
        rounds=5,
        core=0,
        processor="a processor",
    )
    monkeypatch.setattr(benchmark, "benchmark", lambda *_, **__: result)


def test_it_prints_a_table_and_names_who_is_missing(equipoise, measured):
    ran = equipoise("bench")
    assert ran.code == 0
    assert "2,000,000" in ran.out
    assert "200.0" in ran.out
    assert "pin cannot be imported" in ran.out


def test_json_has_steps_per_second_and_ratios_by_name(equipoise, measured):
    found = equipoise("bench", "--json").json
    assert found["steps_per_second"] == {"equipoise": 2e6, "gymnasium": 1e4}
    assert found["ratios"] == {"gymnasium": 200.0}
    assert "pinocchio" in found["missing"]


def test_an_unknown_arm_is_refused(refused):
    refused("bench", "--arm", "r2d2", saying="there is no arm 'r2d2'")
