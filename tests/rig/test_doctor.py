"""What readings mean: each finding that is not good has its cure, and the worst one counts."""

import numpy as np
import pytest

from equipoise.rig.checks.deadlines import (
    check_lateness,
    check_loaded_lateness,
    check_stalls,
    stalls,
)
from equipoise.rig.checks.encoder import EncoderReading, check_encoder
from equipoise.rig.checks.host import HostInfo, check_host, check_realtime
from equipoise.rig.checks.link import check_link, check_networks
from equipoise.rig.checks.results import Spread
from equipoise.rig.doctor import diagnose
from equipoise.rig.realtime import ALLOW, RealtimeSetting

GOOD = HostInfo(
    system="Linux",
    kernel="6.8.1-realtime",
    realtime=True,
    cores=8,
    governors=("performance",),
    rtprio=99,
    memlock="unlimited",
    load=0.1,
    swap=0,
    hosts=(),
    networks={"eno1": False},
    free=200 * 2**30,
)
MEASURES = (
    RealtimeSetting("garbage collection", True, "off"),
    RealtimeSetting("memory locked", True, "all pages stay in memory"),
    RealtimeSetting("real-time priority", True, "SCHED_FIFO 60"),
    RealtimeSetting("own core", True, "core 7"),
)


def spread(*durations, n=10_000):
    """Return the spread of n durations of 0.1 ms [s], the last of them replaced."""
    return Spread.of(np.array([1e-4] * (n - len(durations)) + list(durations)))


PUNCTUAL = spread()


def machine(**fields):
    return GOOD.model_copy(update=fields)


def finding(findings, name):
    (found,) = [finding for finding in findings if finding.name == name]
    return found


def test_a_machine_without_a_flaw_is_fit():
    diagnosis = diagnose(GOOD, MEASURES, PUNCTUAL, loaded=PUNCTUAL)
    assert diagnosis.verdict == "fit"
    assert {found.verdict for found in diagnosis.findings} == {"good"}
    assert {found.cure for found in diagnosis.findings} == {""}


FLAWS = {
    "another system": ({"system": "Darwin"}, "kernel", "warning", "from Linux"),
    "a stock kernel": ({"realtime": False}, "kernel", "warning", "PREEMPT_RT"),
    "an unknown kernel": ({"realtime": None}, "kernel", "unknown", "uname -v"),
    "a lazy governor": ({"governors": ("powersave",)}, "clock rate", "warning", "cpupower"),
    "some lazy cores": (
        {"governors": ("performance", "powersave")},
        "clock rate",
        "warning",
        "cpupower frequency-set -g performance",
    ),
    "no governor": ({"governors": None}, "clock rate", "unknown", "its host decides"),
    "one core": ({"cores": 1}, "cores", "warning", "two or more"),
    "unknown cores": ({"cores": None}, "cores", "unknown", "two or more"),
    "a virtual machine": ({"hosts": ("virtual machine",)}, "bare machine", "warning", "itself"),
    "a container": ({"hosts": ("container",)}, "bare machine", "warning", "--ulimit rtprio=99"),
    "unknown hosts": ({"hosts": None}, "bare machine", "unknown", "make sure"),
    "other work": ({"load": 4.1}, "other work", "warning", "`top`"),
    "unknown work": ({"load": None}, "other work", "unknown", "`uptime`"),
    "memory in swap": ({"swap": 2**20}, "swap", "warning", "swapoff"),
    "unknown swap": ({"swap": None}, "swap", "unknown", "`free`"),
    "a full disk": ({"free": 2**29}, "room for logs", "warning", "make room"),
    "an unknown disk": ({"free": None}, "room for logs", "unknown", "`df`"),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_each_flaw_of_a_machine_has_its_cure(flaw):
    fields, name, state, cure = FLAWS[flaw]
    findings = list(check_host(machine(**fields)))
    found = finding(findings, name)
    assert found.verdict == state
    assert cure in found.cure
    assert [other.verdict for other in findings if other is not found] == ["good"] * 6
    worst = diagnose(machine(**fields), MEASURES, PUNCTUAL).verdict
    assert worst == ("usable with care" if state == "warning" else "fit")


def test_the_load_is_judged_by_the_cores_that_share_it():
    assert finding(check_host(machine(load=3.9)), "other work").verdict == "good"
    assert finding(check_host(machine(load=3.9, cores=4)), "other work").verdict == "warning"
    assert finding(check_host(machine(load=0.6, cores=None)), "other work").verdict == "warning"


def test_what_the_machine_did_not_allow_has_the_cure_of_its_setting():
    denied = RealtimeSetting("real-time priority", False, "not allowed", ALLOW)
    taken, missing = check_realtime([MEASURES[2], denied])
    assert (taken.verdict, taken.cure) == ("good", "")
    assert (missing.verdict, missing.found) == ("warning", "not allowed")
    for line in ("@realtime - rtprio 99", "@realtime - memlock unlimited", "usermod -aG realtime"):
        assert line in missing.cure
    assert diagnose(GOOD, [denied], PUNCTUAL).verdict == "usable with care"


@pytest.mark.parametrize(
    ("late", "state"),
    [
        ((), "good"),
        ((0.004,), "good"),
        ((0.0051,), "warning"),
        ((0.0199,), "warning"),
        ((0.0801,), "warning"),
        ((0.0015,) * 150, "warning"),
        ((0.0015,) * 50, "good"),
    ],
)
def test_a_late_deadline_costs_by_how_late_it_was(late, state):
    found = check_lateness(spread(*late))
    assert found.verdict == state
    assert bool(found.cure) == (state != "good")


@pytest.mark.parametrize(
    ("longest", "state", "saying"),
    [(0.0199, "good", "none above 20 ms"), (0.0699, "warning", "rides through 70 ms"),
     (0.0701, "bad", "ends at 70 ms")],
)  # fmt: skip
def test_a_stall_counts_once_and_is_told_by_whether_a_run_outlasts_it(longest, state, saying):
    # A stall of the longest and one of 23 ms, each with the later deadlines that it makes late.
    late = np.zeros(200)
    late[20:35] = np.maximum(longest - 0.005 * np.arange(15), 0.0)
    late[100:105] = 0.023 - 0.005 * np.arange(5)
    found = stalls(late if longest > 0.02 else np.minimum(late, 0.02))
    assert found == ((longest, 0.023) if longest > 0.02 else ())
    result = check_stalls(found, 1.0)
    assert result.verdict == state
    assert saying in result.found
    if found:
        assert result.found.startswith("2 above 20 ms in 1 s, 1 above 40 ms")
    assert diagnose(GOOD, MEASURES, PUNCTUAL, found).stalls == found


def test_under_load_lateness_is_at_worst_a_matter_of_care():
    assert check_loaded_lateness(PUNCTUAL).verdict == "good"
    found = check_loaded_lateness(spread(0.5))
    assert found.verdict == "warning"
    assert "PREEMPT_RT" in found.cure
    assert diagnose(GOOD, MEASURES, PUNCTUAL, loaded=spread(0.5)).verdict == "usable with care"


@pytest.mark.parametrize(
    ("trip", "state"), [(0.001, "good"), (0.0039, "good"), (0.006, "warning"), (0.0095, "bad")]
)
def test_a_slow_link_is_cured_by_a_cable_of_its_own(trip, state):
    found = check_link(spread(*[trip] * 200))
    assert found.verdict == state
    assert ("direct cable" in found.cure) == (state != "good")


def test_one_slow_answer_of_many_does_not_condemn_a_link():
    assert check_link(spread(0.05)).verdict == "good"


@pytest.mark.parametrize(
    ("networks", "state"),
    [
        ({"eno1": False}, "good"),
        ({"eno1": False, "eno2": False}, "warning"),
        ({"wlan0": True}, "warning"),
        ({}, "unknown"),
        (None, "unknown"),
    ],
)
def test_a_second_network_is_told_where_a_robot_is_at_the_first(networks, state):
    found = check_networks(networks)
    assert found.verdict == state
    assert bool(found.cure) == (state != "good")
    names = {one.name for one in diagnose(GOOD, MEASURES, PUNCTUAL, link=PUNCTUAL).findings}
    assert names >= {"link to the robot", "networks"}
    assert "networks" not in {one.name for one in diagnose(GOOD, MEASURES, PUNCTUAL).findings}


@pytest.mark.parametrize(
    ("name", "error", "found", "cure"),
    [
        (
            "encoder",
            "there is no /dev/x; plug it in; then again",
            "there is no /dev/x",
            "plug it in; then again",
        ),
        ("robot", "robot: no answer; look", "no answer", "look"),
        ("robot", "it is gone", "it is gone", "check its power, its cable and its address"),
    ],
)
def test_a_device_that_is_not_there_makes_the_rig_unfit(name, error, found, cure):
    diagnosis = diagnose(GOOD, MEASURES, PUNCTUAL, silent={name: error})
    assert diagnosis.verdict == "not fit"
    last = diagnosis.findings[-1]
    assert (last.name, last.verdict, last.found, last.cure) == (name, "bad", found, cure)


def heard(rate=1000.0, age=0.0015, delay=0.0003, **fields):
    told = {"counts_per_rev": 8192, "missing": 0, "rejected": 0, "illegal": 0, "moved": 0}
    return EncoderReading(
        rate=rate,
        delay=Spread.of(np.full(round(2.0 * rate), delay)) if rate else None,
        age=Spread.of(np.full(2000, age)),
        **{**told, **fields},
    )


def test_a_good_encoder_is_fit():
    findings = list(check_encoder(heard(), 8192))
    assert {found.verdict for found in findings} == {"good"}
    assert heard().rate == 1000.0
    assert "1000 per second, newest 1.5 ms old (p99), arrival 0.3 ms late" in findings[1].found
    assert diagnose(GOOD, MEASURES, PUNCTUAL, link=PUNCTUAL, encoder=heard()).verdict == "fit"


ENCODERS = {
    "other counts": ({"counts_per_rev": 4096}, "encoder's counts", "bad", "rig.toml"),
    "a slow board": ({"rate": 400.0}, "encoder's samples", "warning", "latency timer"),
    "a crawling board": ({"rate": 150.0}, "encoder's samples", "bad", "native USB"),
    "a dead board": ({"rate": 0.0}, "encoder's samples", "bad", "native USB"),
    "a buffering adapter": ({"age": 0.016}, "encoder's samples", "warning", "latency timer"),
    "a stalling adapter": ({"age": 0.021}, "encoder's samples", "bad", "latency timer"),
    "a bad wire": ({"missing": 21}, "encoder's line", "warning", "change the cable"),
    "a noisy wire": ({"rejected": 21}, "encoder's line", "warning", "change the cable"),
    "lost edges": ({"illegal": 1}, "encoder's signals", "bad", "supply, screen"),
}


@pytest.mark.parametrize("flaw", ENCODERS)
def test_each_flaw_of_an_encoder_has_its_cure(flaw):
    fields, name, state, cure = ENCODERS[flaw]
    findings = list(check_encoder(heard(**fields), 8192))
    found = finding(findings, name)
    assert found.verdict == state
    assert cure in found.cure
    assert {other.verdict for other in findings if other is not found} == {"good"}
    verdict = diagnose(GOOD, MEASURES, PUNCTUAL, encoder=heard(**fields), counts_per_rev=8192)
    assert verdict.verdict == ("not fit" if state == "bad" else "usable with care")


def test_what_is_not_expected_is_not_judged():
    findings = list(check_encoder(heard(counts_per_rev=600)))
    assert {found.verdict for found in findings} == {"good"}


def test_a_spread_says_what_numpy_says():
    durations = np.random.default_rng(0).exponential(0.004, 5000)
    found = Spread.of(durations)
    assert found.n == 5000
    assert found.median == np.median(durations)
    ordered = np.sort(durations)
    assert ordered[4944] <= found.p99 <= ordered[4955]
    assert ordered[4990] <= found.p99_9 <= ordered[4999]
    assert found.most == durations.max()
    # An exponential of mean 4 ms: exp(-t / 4 ms), five standard deviations of a share of 5000.
    for t, share in found.longer.items():
        expected = np.exp(-float(t) / 4.0)
        assert share == pytest.approx(expected, abs=5.0 * np.sqrt(expected * (1 - expected) / 5000))
    assert list(found.longer) == ["1", "5", "20", "70"]


def test_a_histogram_counts_each_duration_once_in_its_range():
    found = Spread.of(np.array([0.0, 9e-6, 1e-5, 1.1e-5, 3e-4, 0.7, 2.0]))
    assert sum(count for _, count in found.histogram) == 7
    by_end = dict(found.histogram)
    assert by_end[1e-5] == 3
    assert by_end[2e-5] == 1
    assert by_end[5e-4] == 1
    assert by_end[None] == 2
    assert len(found.histogram) == 16
    assert Spread.of(np.array([0.003])).histogram == ((pytest.approx(0.005), 1),)
