"""Is this machine, and is this rig, fit for a run? Readings become findings, each with its cure.

Nothing here measures: `equipoise.devices.host` and `equipoise.devices.probes` do, and what they
found is judged against what a run needs. A reading that could not be had is a finding of its own:
it says so, says how to have it, and counts neither for nor against the machine.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final, Literal, Self

import numpy as np
import numpy.typing as npt

from equipoise.artefacts import Value
from equipoise.control.safety import ENCODER_STALE
from equipoise.deployment import preflight
from equipoise.deployment.preflight import line_verdict, link_verdict, stream_verdict
from equipoise.devices.host import HostInfo
from equipoise.devices.probes import PERIOD, Heard
from equipoise.devices.realtime import RealtimeSetting

if TYPE_CHECKING:
    from rich.table import Table

Array = npt.NDArray[np.float64]

State = Literal["good", "care", "bad", "unknown"]
Verdict = Literal["fit", "usable with care", "not fit"]

SHARES: Final = (0.001, PERIOD, ENCODER_STALE)
"""Deadlines that were missed by more than these are counted [s]: by a jitter that a controller does
not feel, by a whole period of the stream, and by what is a fault in a run."""
PUNCTUAL: Final = 0.001
"""99 of 100 deadlines are met within this [s]: a fifth of the stream's period, and well below the
delay of the arm, so that nothing of it is felt."""
FAULT: Final = ENCODER_STALE
"""A deadline missed by more than this ends a run [s]: two ticks went by without a decision, and a
pendulum that falls gains a sixth (exp(8.4 * 0.02) - 1) in that time."""
BUSY: Final = 0.5
"""With more than this share of the cores at work before a run begins, the loop competes [-]."""
ROOM: Final = 1 << 30
"""A run of ten minutes writes tens of megabytes; with less than this left [B] a day's runs may not
fit, and a full disk ends a log."""
STATES: Final[Mapping[preflight.Verdict, State]] = {
    "good": "good",
    "warning": "care",
    "refused": "bad",
}
"""What a verdict of the pre-flight is called here, where nothing is refused."""

EDGES: Final = tuple(digit * 10.0**power for power in range(-5, 0) for digit in (1.0, 2.0, 5.0))
"""Upper ends of a histogram's ranges [s], from 10 us to 0.5 s; the last range has none."""

GROUP: Final = (
    "sudo groupadd -f realtime; sudo usermod -aG realtime $USER; put `@realtime - rtprio 99` and "
    "`@realtime - memlock unlimited` into /etc/security/limits.conf; log in again"
)
"""How Linux allows real-time priority and locked memory."""


class Spread(Value):
    """How a duration spreads over many measurements."""

    n: int
    """How many there are."""
    median: float
    """Half are no longer [s]."""
    p99: float
    """99 of 100 are no longer [s]."""
    p99_9: float
    """999 of 1000 are no longer [s]."""
    most: float
    """The longest [s]."""
    longer: dict[str, float]
    """Share that is longer than 1, 5 and 20 ms, by that time [ms]."""
    histogram: tuple[tuple[float | None, int], ...]
    """Upper ends of ranges [s] and how many lie there, first to last that hold any; none where the
    range is open."""

    @classmethod
    def of(cls, durations: Array) -> Self:
        """Return the spread of durations [s], shape (n,), n at least 1."""
        median, p99, p99_9 = np.percentile(durations, (50.0, 99.0, 99.9)).tolist()
        counts = np.bincount(
            np.searchsorted(EDGES, durations, side="left"), minlength=len(EDGES) + 1
        ).tolist()
        held = [place for place, count in enumerate(counts) if count]
        ends = (*EDGES, None)
        return cls(
            n=len(durations),
            median=median,
            p99=p99,
            p99_9=p99_9,
            most=float(durations.max()),
            longer={f"{1e3 * t:g}": float((durations > t).mean()) for t in SHARES},
            histogram=tuple((ends[k], counts[k]) for k in range(held[0], held[-1] + 1)),
        )


class EncoderReading(Value):
    """What an encoder showed."""

    counts_per_rev: int
    """Counts per revolution, after x4, as the board says."""
    rate: float
    """Samples in a second [1/s]."""
    delay: Spread | None
    """From a count to its arrival, beyond what the fastest line takes; none without samples."""
    age: Spread
    """Age of the newest sample at any moment."""
    missing: int
    """Samples that were lost on the way."""
    rejected: int | None
    """Lines that were damaged or did not follow, where they are counted."""
    illegal: int
    """Samples whose board had met a transition that cannot be."""
    moved: int
    """Counts between the lowest and the highest."""

    @classmethod
    def of(cls, heard: Heard) -> Self:
        """Return what was heard, in brief."""
        n = len(heard.delays)
        return cls(
            counts_per_rev=heard.counts_per_rev,
            rate=n / heard.seconds,
            delay=Spread.of(heard.delays) if n else None,
            age=Spread.of(heard.ages),
            missing=heard.missing,
            rejected=heard.rejected,
            illegal=heard.illegal,
            moved=heard.moved,
        )


class DoctorCheck(Value):
    """What was found of one thing, and what to do about it."""

    name: str
    """What was looked at."""
    state: State
    """Good; to be taken care of; bad, so that no run should follow; or unknown."""
    found: str
    """What is so."""
    cure: str = ""
    """What to do about it; empty where all is well."""


class Diagnosis(Value):
    """All that was read, and what it means."""

    verdict: Verdict
    """Whether a run may follow."""
    findings: tuple[DoctorCheck, ...]
    """One for each thing that was looked at."""
    machine: HostInfo
    """The machine."""
    lateness: Spread
    """How late deadlines were met."""
    loaded: Spread | None
    """The same while every core was kept busy."""
    link: Spread | None
    """Round trips to the robot."""
    encoder: EncoderReading | None
    """What the encoder showed."""


def diagnose(
    machine: HostInfo,
    measures: Sequence[RealtimeSetting],
    lateness: Spread,
    *,
    loaded: Spread | None = None,
    link: Spread | None = None,
    encoder: EncoderReading | None = None,
    counts_per_rev: int | None = None,
    silent: Mapping[str, str] | None = None,
) -> Diagnosis:
    """Judge readings.

    Args:
        machine: What the machine says of itself.
        measures: What it allowed for the sake of punctuality.
        lateness: How late deadlines were met.
        loaded: The same while every core was kept busy.
        link: Round trips to the robot.
        encoder: What the encoder showed.
        counts_per_rev: What the rig expects of the encoder, after x4.
        silent: Why a device was not to be had, by its name.
    """
    findings = [
        *judge_machine(machine),
        *judge_measures(measures, machine),
        judge_lateness(lateness),
    ]
    if loaded is not None:
        findings.append(judge_loaded(loaded))
    if link is not None:
        findings += [judge_link(link), judge_networks(machine)]
    if encoder is not None:
        findings += judge_encoder(encoder, counts_per_rev)
    findings += [judge_silence(name, why) for name, why in (silent or {}).items()]
    return Diagnosis(
        verdict=verdict(findings),
        findings=tuple(findings),
        machine=machine,
        lateness=lateness,
        loaded=loaded,
        link=link,
        encoder=encoder,
    )


def verdict(findings: Sequence[DoctorCheck]) -> Verdict:
    """Return what findings mean together: the worst of them counts."""
    states = {finding.state for finding in findings}
    if "bad" in states:
        return "not fit"
    return "usable with care" if "care" in states else "fit"


def judge_machine(machine: HostInfo) -> Iterator[DoctorCheck]:
    """Judge what a machine says of itself."""
    yield _kernel(machine)
    yield _governor(machine)
    yield _cores(machine)
    yield _host(machine)
    yield _load(machine)
    yield _swap(machine)
    yield _disk(machine)


def judge_measures(measures: Sequence[RealtimeSetting], machine: HostInfo) -> Iterator[DoctorCheck]:
    """Judge what a machine allowed for the sake of punctuality."""
    limits = {
        "real-time priority": f"the limit rtprio is {_said(machine.rtprio)}",
        "memory locked": f"the limit memlock is {_said(machine.memlock, 1024)}",
    }
    for measure in measures:
        name = measure.name
        if measure.taken:
            yield DoctorCheck(name=name, state="good", found=measure.note)
        elif name in limits and machine.system == "Linux":
            found = f"not allowed; {limits[name]}"
            yield DoctorCheck(name=name, state="care", found=found, cure=GROUP)
        else:
            yield DoctorCheck(name=name, state="care", found="not possible here", cure=measure.note)


def judge_lateness(lateness: Spread) -> DoctorCheck:
    """Judge how late deadlines were met."""
    name, found = "deadlines", _spread(lateness)
    if lateness.most > FAULT:
        cure = (
            f"a run ends at {1e3 * FAULT:g} ms: end other programs, then cure what stands above "
            "(kernel, governor, priority); measure again with --seconds 60"
        )
        return DoctorCheck(name=name, state="bad", found=found, cure=cure)
    if _uneven(lateness):
        cure = (
            "setpoints will come unevenly: end other programs, set the governor, allow real-time "
            "priority; measure again with --seconds 60"
        )
        return DoctorCheck(name=name, state="care", found=found, cure=cure)
    return DoctorCheck(name=name, state="good", found=found)


def judge_loaded(loaded: Spread) -> DoctorCheck:
    """Judge how late deadlines were met while every core was kept busy.

    At worst it asks for care: in a run nobody needs to keep the cores busy.
    """
    name, found = "deadlines under load", _spread(loaded)
    if _uneven(loaded):
        cure = (
            "nothing else may run during a run; allow real-time priority, and take a kernel with "
            "PREEMPT_RT"
        )
        return DoctorCheck(name=name, state="care", found=found, cure=cure)
    return DoctorCheck(name=name, state="good", found=found)


def _uneven(lateness: Spread) -> bool:
    """Return whether setpoints would come unevenly."""
    return lateness.p99 > PUNCTUAL or lateness.most > PERIOD


def judge_link(link: Spread) -> DoctorCheck:
    """Judge round trips to the robot."""
    name, found = "link to the robot", _spread(link)
    cure = (
        "connect cabinet and computer by one direct cable, on a network card of their own (no "
        "USB adapter, no Wi-Fi), and switch other networks off; then see docs/how-to/real-time.md"
    )
    return _judged(name, link_verdict(link.p99), found, cure)


def judge_networks(machine: HostInfo) -> DoctorCheck:
    """Judge what else the machine is connected to, where a robot is at one of its networks."""
    name, networks = "networks", machine.networks
    if not networks:
        cure = "make sure that only the robot's is switched on"
        return DoctorCheck(name=name, state="unknown", found="cannot be read here", cure=cure)
    found = ", ".join(f"{card}{' (wireless)' * air}" for card, air in networks.items())
    if len(networks) > 1 or any(networks.values()):
        cure = "switch off all but the card with the robot's cable (`nmcli device disconnect ...`)"
        return DoctorCheck(name=name, state="care", found=found, cure=cure)
    return DoctorCheck(name=name, state="good", found=found)


def judge_silence(name: str, why: str) -> DoctorCheck:
    """Judge a device that was not to be had.

    Args:
        name: What it is called.
        why: What its driver said: what is wrong, and after a semicolon what to do.
    """
    found, _, cure = why.removeprefix(f"{name}: ").partition("; ")
    cure = cure or "check its power, its cable and its address"
    return DoctorCheck(name=name, state="bad", found=found, cure=cure)


def judge_encoder(
    encoder: EncoderReading, counts_per_rev: int | None = None
) -> Iterator[DoctorCheck]:
    """Judge what an encoder showed.

    Args:
        encoder: What it showed.
        counts_per_rev: What the rig expects, after x4; none where it is not known.
    """
    told = f"{encoder.counts_per_rev} per revolution"
    if counts_per_rev is not None and counts_per_rev != encoder.counts_per_rev:
        yield DoctorCheck(
            name="encoder's counts",
            state="bad",
            found=f"{told}, the rig says {counts_per_rev}",
            cure="correct counts_per_rev in rig.toml, or COUNTS_PER_REV in the firmware",
        )
    else:
        yield DoctorCheck(name="encoder's counts", state="good", found=told)
    yield _stream(encoder)
    yield _losses(encoder)
    if encoder.illegal:
        yield DoctorCheck(
            name="encoder's signals",
            state="bad",
            found=f"{encoder.illegal} samples with transitions that cannot be",
            cure="counts are being lost: check the encoder's supply, screen and plugs, and keep "
            "its cable away from the motors'",
        )
    else:
        yield DoctorCheck(name="encoder's signals", state="good", found="no illegal transition")


def _stream(encoder: EncoderReading) -> DoctorCheck:
    name, age = "encoder's samples", encoder.age
    found = f"{encoder.rate:.0f} in a second, newest {1e3 * age.p99:.1f} ms old (p99)"
    if encoder.delay is not None:
        found += f", arrival {1e3 * encoder.delay.p99:.1f} ms late (p99)"
    cure = (
        "use a board with native USB (Teensy, Pico), or set the adapter's latency timer to 1 ms: "
        "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer"
    )
    return _judged(name, stream_verdict(encoder.rate, age.p99), found, cure)


def _losses(encoder: EncoderReading) -> DoctorCheck:
    name, rejected = "encoder's line", encoder.rejected
    found = f"{encoder.missing} samples lost" + (
        ", rejected ones are not counted here" if rejected is None else f", {rejected} rejected"
    )
    n = encoder.delay.n if encoder.delay is not None else 0
    cure = "change the cable, keep it away from the motors', and check the baud rate"
    return _judged(name, line_verdict(encoder.missing + (rejected or 0), n), found, cure)


def _judged(name: str, verdict: preflight.Verdict, found: str, cure: str) -> DoctorCheck:
    """Return a finding on what the pre-flight of a run judges as well."""
    state = STATES[verdict]
    return DoctorCheck(name=name, state=state, found=found, cure="" if state == "good" else cure)


def _kernel(machine: HostInfo) -> DoctorCheck:
    name = "kernel"
    found = f"{machine.system} {machine.kernel or ''}".rstrip()
    if machine.system != "Linux":
        cure = "it has no real-time priority for a loop; drive a robot from Linux"
        return DoctorCheck(name=name, state="care", found=found, cure=cure)
    if machine.realtime is None:
        cure = "look whether `uname -v` says PREEMPT_RT"
        found += "; whether it is PREEMPT_RT cannot be read here"
        return DoctorCheck(name=name, state="unknown", found=found, cure=cure)
    if not machine.realtime:
        cure = (
            "install a kernel with PREEMPT_RT: on Ubuntu `sudo pro enable realtime-kernel`, on "
            "Debian `sudo apt install linux-image-rt-amd64`; then restart"
        )
        return DoctorCheck(name=name, state="care", found=f"{found}, not PREEMPT_RT", cure=cure)
    return DoctorCheck(name=name, state="good", found=f"{found}, PREEMPT_RT")


def _governor(machine: HostInfo) -> DoctorCheck:
    name = "clock rate"
    if machine.governors is None:
        return DoctorCheck(
            name=name,
            state="unknown",
            found="what governs it cannot be read here",
            cure="where a virtual machine runs the host decides: set `performance` there",
        )
    found = f"governor {', '.join(machine.governors)}"
    if machine.governors != ("performance",):
        cure = "sudo cpupower frequency-set -g performance"
        return DoctorCheck(name=name, state="care", found=found, cure=cure)
    return DoctorCheck(name=name, state="good", found=found)


def _cores(machine: HostInfo) -> DoctorCheck:
    name, cores = "cores", machine.cores
    if cores is None:
        cure = "look whether the machine has two or more"
        return DoctorCheck(name=name, state="unknown", found="cannot be read here", cure=cure)
    if cores < 2:
        cure = "the loop needs one to itself, and the log another: use a machine with two or more"
        return DoctorCheck(name=name, state="care", found=f"{cores}", cure=cure)
    return DoctorCheck(name=name, state="good", found=f"{cores}")


def _host(machine: HostInfo) -> DoctorCheck:
    name, hosts = "bare machine", machine.hosts
    if hosts is None:
        cure = "make sure that no virtual machine or container is between"
        return DoctorCheck(name=name, state="unknown", found="cannot be read here", cure=cure)
    if hosts:
        found = f"no: {' and '.join(hosts)}"
        cure = "its host may stall it at any time: run on the machine itself"
        if hosts == ("container",):
            cure = (
                "run outside the container, or give it --ulimit rtprio=99 --ulimit memlock=-1 "
                "--network host and the encoder's device"
            )
        return DoctorCheck(name=name, state="care", found=found, cure=cure)
    return DoctorCheck(name=name, state="good", found="no sign of a virtual machine or a container")


def _load(machine: HostInfo) -> DoctorCheck:
    name, load = "other work", machine.load
    if load is None:
        cure = "look with `uptime` what else runs"
        return DoctorCheck(name=name, state="unknown", found="cannot be read here", cure=cure)
    found = f"{load:.2f} processes at work over the last minute"
    if load > BUSY * (machine.cores or 1):
        cure = "see with `top` what works, and end it; wait a minute and look again"
        return DoctorCheck(name=name, state="care", found=found, cure=cure)
    return DoctorCheck(name=name, state="good", found=found)


def _swap(machine: HostInfo) -> DoctorCheck:
    name, swap = "swap", machine.swap
    if swap is None:
        cure = "look with `free` that nothing lies in swap"
        return DoctorCheck(name=name, state="unknown", found="cannot be read here", cure=cure)
    found = f"{swap / 2**20:.0f} MiB in use" if swap else "nothing there"
    if swap:
        cure = "memory is short: end other programs, then sudo swapoff -a"
        return DoctorCheck(name=name, state="care", found=found, cure=cure)
    return DoctorCheck(name=name, state="good", found=found)


def _disk(machine: HostInfo) -> DoctorCheck:
    name, free = "room for logs", machine.free
    if free is None:
        cure = "look with `df` at the folder of the logs"
        return DoctorCheck(name=name, state="unknown", found="cannot be read here", cure=cure)
    found = f"{free / 2**30:.1f} GiB"
    if free < ROOM:
        cure = "a full disk ends a log, not a run: make room, or give another folder"
        return DoctorCheck(name=name, state="care", found=found, cure=cure)
    return DoctorCheck(name=name, state="good", found=found)


def _said(limit: int | str | None, unit: int = 0) -> str:
    if limit is None:
        return "not known"
    if isinstance(limit, str):
        return limit
    return f"{limit // unit} KiB" if unit else f"{limit}"


def _spread(spread: Spread) -> str:
    times = (spread.median, spread.p99, spread.p99_9, spread.most)
    median, p99, p99_9, most = (f"{1e3 * t:.2f}" for t in times)
    return f"median {median} ms, p99 {p99}, p99.9 {p99_9}, at most {most} ({spread.n} in all)"


EIGHTHS: Final = " ▏▎▍▌▋▊▉█"
WIDTH: Final = 40
"""Characters of the longest bar."""


def bars(spread: Spread) -> "Table":
    """Return a histogram as bars of characters, a range on each line."""
    from rich.table import Table

    drawn = Table.grid(padding=(0, 2, 0, 0))
    drawn.add_column(justify="right", style="dim", no_wrap=True)
    drawn.add_column(no_wrap=True)
    drawn.add_column(justify="right", no_wrap=True)
    most = max(count for _, count in spread.histogram)
    for end, count in spread.histogram:
        label = f"over {1e3 * EDGES[-1]:g} ms" if end is None else f"to {1e3 * end:g} ms"
        drawn.add_row(f"  {label}", bar(count, most), f"{count}" if count else "")
    return drawn


def bar(count: int, most: int) -> str:
    """Return a bar for a count of at most `most`; what is there at all is seen.

    Example:
        >>> bar(40, 40) == 40 * "█", bar(1, 100_000), bar(0, 5)
        (True, '▏', '')
    """
    eighths = max(round(8 * WIDTH * count / most), 1) if count else 0
    whole, rest = divmod(eighths, 8)
    return EIGHTHS[-1] * whole + (EIGHTHS[rest] if rest else "")
