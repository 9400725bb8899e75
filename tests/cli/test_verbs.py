"""Each verb once: what it writes, and its JSON object."""

import signal
import threading

import numpy as np
import pytest

from equipoise import Actuator, Evaluation, Pendulum, RunLog, simulate_run
from equipoise.control.policy import TabularPolicy, shipped_policy
from tests.cli.conftest import contents
from tests.identification.test_refine import policy_knowing, run

SHORT = (
    *("--episodes=40", "--workers=1", "--set=learning.episode_duration=1"),
    *("--set=selection.every=20", "--set=selection.late=1", "--set=selection.trials=4"),
    *("--set=selection.duration=4", "--set=selection.test_trials=100"),
)
FEW = ("--trials=4", "--duration=1", "--workers=1")


def test_identify_writes_pendulum_and_figure(equipoise, swing, tmp_path):
    weighed = ("--mass=0.2", "--mass-uncertainty=0.001", "--length=0.14")
    ran = equipoise("identify", swing, "--friction=coulomb", *weighed)
    assert "w2 [1/s^2]" in ran.out
    assert "(95 %, identified)" in ran.out
    assert "zero [deg]" in ran.out
    assert ran.out.endswith("next: equipoise train pendulum.json\n")
    pendulum = Pendulum.load(tmp_path / "pendulum.json")
    assert pendulum.w2.value == pytest.approx(70.2, rel=0.05)
    assert (pendulum.friction_model, pendulum.inertia is None) == ("coulomb", False)
    assert {"pendulum.json", "pendulum.svg", "pendulum.png"} < contents(tmp_path).keys()


def test_train_writes_a_policy_and_marks_one_that_misses_the_target(equipoise, pendulum_file):
    target = ("--target=0.9", "--attempts=2")
    ran = equipoise("train", pendulum_file, *SHORT, *target, "--json", code=1)
    assert ran.err == ""
    assert ran.json["seed"] in (0, 1)
    policy = TabularPolicy.load("policy.json")
    assert policy.shortfall
    assert policy.pendulum == Pendulum.load(pendulum_file)
    equipoise("train", *SHORT, "--target=0", "--force")


def test_a_hanging_pendulum_is_swung_up(equipoise, tmp_path):
    few = ("--start=hanging", "--world=model", "--duration=1", "--json")
    ran = equipoise("evaluate", "--trials=2", "--no-baselines", *few).json
    assert ran["survived"] == 2
    assert 2.0 < ran["upright_median_s"] <= ran["upright_max_s"] < 15.0
    ran = equipoise("deploy", *few, "--out=run.mcap").json
    assert (ran["outcome"], ran["survival_s"]) == ("survived", 1.0)
    found = equipoise("log", "explain", "run.mcap", "--json").json
    assert found["survival_s"] == 1.0
    assert found["phi_deg"]["largest"] < 11.0


def test_evaluate_compares_with_baselines(equipoise, policy_file, tmp_path):
    ran = equipoise("evaluate", policy_file, *FEW, "--json", "--out=evaluation.json", code=None)
    evaluation = Evaluation.load(tmp_path / "evaluation.json")
    summary = evaluation.results.summary()
    assert ran.code == int(summary.median < 1.0)
    assert ran.json["median_s"] == summary.median
    assert set(ran.json["baselines"]) == {item.name for item in evaluation.baselines}
    before = contents(tmp_path)
    assert "LQR" in equipoise("evaluate", policy_file, *FEW, code=None).out
    assert contents(tmp_path) == before


def test_a_claim_is_granted_or_refused(equipoise, tmp_path):
    claim = ("evaluate", "--duration=0.5", "--trials=20", "--json")
    ran = equipoise(*claim, "--claim=0.8")
    assert ran.json["granted"]
    assert ran.json["bound_95"] == pytest.approx(0.05 ** (1 / 20))  # p^n = 0.05
    ran = equipoise("evaluate", "random", *claim[1:], "--claim=0.8", code=1)
    assert not ran.json["granted"]


def test_deploy_and_the_verbs_for_logs(equipoise, tmp_path):
    equipoise("deploy", "--duration=0.5")
    assert RunLog.load(tmp_path / "run.mcap").conditions.world == "twin:nominal"
    found = equipoise("deploy", "--duration=0.5", "--force", "--json").json
    assert found["survival_s"] == 0.5
    assert "x [mm]" in equipoise("log", "explain", "run.mcap").out
    found = equipoise("log", "explain", "run.mcap", "--json").json
    log = RunLog.load(tmp_path / "run.mcap")
    largest = pytest.approx(1e3 * np.abs(log.ticks.estimated_x).max())
    assert found["x_mm"] == found["x_mm"] | {"largest": largest, "limit": 220.0}
    equipoise("log", "export", "run.mcap")
    made = {path.name for path in (tmp_path / "run-csv").iterdir()}
    assert made == {"encoder.csv", "reply.csv", "stream.csv", "tick.csv", "truth.csv"}
    equipoise("deploy", "random", "--force", code=1)
    assert "evidence" in equipoise("log", "explain", "run.mcap").out
    found = equipoise("log", "explain", "run.mcap", "--json").json
    assert found["cause"] in found["causes"]


def test_an_excitation_becomes_an_actuator(equipoise, tmp_path):
    equipoise("deploy", "--excite", "--out", "log.mcap")
    found = equipoise("identify", "log.mcap", "--json").json
    assert found["kind"] == "kst"
    assert found["delay"]["value"] == pytest.approx(0.010, abs=0.002)
    assert Actuator.load(tmp_path / "actuator.json").delay.value == found["delay"]["value"]


def test_refine_writes_what_moved(equipoise):
    policy_knowing().save("policy.json")
    run(7, 1.1).save("run.mcap")
    ran = equipoise("refine", "policy.json", "run.mcap", "--json")
    assert (ran.json["pendulum"], ran.json.get("actuator")) == ("refined.json", None)
    moved = Pendulum.load("refined.json").w2.value / shipped_policy().pendulum.w2.value
    assert moved == pytest.approx(1.1, rel=0.01)


@pytest.mark.full
@pytest.mark.parametrize("verb", ["play", "log show run.mcap"])
def test_pages_are_served_until_a_signal(equipoise, monkeypatch, tmp_path, verb):
    simulate_run(shipped_policy(), duration=0.4).save(tmp_path / "run.mcap", command="test")
    threading.Timer(8.0, signal.raise_signal, (signal.SIGINT,)).start()
    ran = equipoise(*verb.split(), "--json")
    assert any(str(item).startswith("http://") for item in ran.json.values())
