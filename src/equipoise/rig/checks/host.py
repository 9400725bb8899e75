"""The machine that runs the loop: its kernel, clock rate, cores, load, swap, networks and disk.

Readings come from `/proc` and `/sys`; nothing is changed. A reading that the system does not offer,
as on macOS and in many containers, is None, and its check is `unknown`.
"""

import platform
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final, Literal, TypeVar

from equipoise.artefacts import Value
from equipoise.rig.checks.results import CheckResult, rated
from equipoise.rig.realtime import RealtimeSetting

T = TypeVar("T")

Limit = int | Literal["unlimited"] | None
"""A limit of the system; None where it cannot be read."""

CONTAINERS: Final = ("docker", "kubepods", "containerd", "lxc", "libpod", "podman")
"""Words in the control group of the first process inside a container."""
HYPERVISORS: Final = ("QEMU", "KVM", "VMware", "VirtualBox", "Virtual Machine", "Xen", "EC2")
"""Words in the names that the firmware of a virtual machine reports."""
MAX_LOAD_SHARE: Final = 0.5
"""Share of the cores at work before a run beyond which other programs compete with the loop [-]."""
MIN_FREE_SPACE: Final = 1 << 30
"""Free space for logs below which a day's runs may not fit [B]; a run of ten minutes writes tens of
megabytes, and a full disk ends a log."""


class HostInfo(Value):
    """Properties of a machine; None where the system does not report one."""

    system: str
    """Operating system: Linux, Darwin, Windows."""
    kernel: str | None
    """Release of the kernel."""
    realtime: bool | None
    """Whether the kernel is PREEMPT_RT."""
    cores: int | None
    """Processor cores that this process may use."""
    governors: tuple[str, ...] | None
    """Governors of the cores' clock rates, each name once."""
    rtprio: Limit
    """Highest real-time priority of this user."""
    memlock: Limit
    """Memory that this user may lock [B]."""
    load: float | None
    """Runnable processes, mean over the last minute."""
    swap: int | None
    """Memory in swap [B]."""
    hosts: tuple[str, ...] | None
    """Layers that schedule this machine: `virtual machine`, `container`."""
    networks: dict[str, bool] | None
    """Network cards in use, by name, and whether each is wireless."""
    free: int | None
    """Free space in the folder of the logs [B]."""


def read_host_info(logs: Path = Path(), *, root: Path = Path("/"), system: str = "") -> HostInfo:
    """Read the properties of the machine.

    Args:
        logs: Folder of the logs; it need not exist yet.
        root: Folder that holds `proc` and `sys`.
        system: Operating system (default: the running one).
    """
    version = _read(root / "proc/version")
    release = platform.release() if root == Path("/") else None
    load = _match(root / "proc/loadavg", r"(\S+)")
    return HostInfo(
        system=system or platform.system(),
        kernel=_match(root / "proc/version", r"version (\S+)") or release,
        realtime=_realtime(root, version),
        cores=_cores(root),
        governors=_governors(root),
        rtprio=_limit(root, "Max realtime priority"),
        memlock=_limit(root, "Max locked memory"),
        load=None if load is None else float(load),
        swap=_swap(root),
        hosts=_hosts(root),
        networks=_networks(root),
        free=_free(logs),
    )


def check_host(host: HostInfo) -> Iterator[CheckResult]:
    """Judge the properties of a machine."""
    if host.system != "Linux":
        cure = "it has no real-time priority for a loop; drive a robot from Linux"
        yield CheckResult("kernel", "warning", f"{host.system} {host.kernel or ''}".rstrip(), cure)
    else:
        kernel = host.kernel or "Linux"
        yield _check(
            "kernel",
            host.realtime,
            lambda realtime: (realtime, f"{kernel}, {'' if realtime else 'not '}PREEMPT_RT"),
            "install a kernel with PREEMPT_RT: on Ubuntu `sudo pro enable realtime-kernel`, on "
            "Debian `sudo apt install linux-image-rt-amd64`; then restart",
            "check whether `uname -v` says PREEMPT_RT",
        )
    yield _check(
        "clock rate",
        host.governors,
        lambda governors: (governors == ("performance",), f"governor {', '.join(governors)}"),
        "sudo cpupower frequency-set -g performance",
        "on a virtual machine its host decides: set `performance` there",
    )
    yield _check(
        "cores",
        host.cores,
        lambda cores: (cores >= 2, f"{cores}"),
        "the loop needs one to itself, and the log another: use a machine with two or more",
        "check that the machine has two or more",
    )
    cure = "its host may stall it at any time: run on the machine itself"
    if host.hosts == ("container",):
        cure = (
            "run outside the container, or give it --ulimit rtprio=99 --ulimit memlock=-1 "
            "--network host and the encoder's device"
        )
    yield _check(
        "bare machine",
        host.hosts,
        lambda hosts: (not hosts, " and ".join(hosts) or "no virtual machine or container found"),
        cure,
        "make sure that no virtual machine or container is between",
    )
    limit = MAX_LOAD_SHARE * (host.cores or 1)
    yield _check(
        "other work",
        host.load,
        lambda load: (load <= limit, f"{load:.2f} processes at work over the last minute"),
        "find it with `top`, and end it; wait a minute and check again",
        "check with `uptime` what else runs",
    )
    yield _check(
        "swap",
        host.swap,
        lambda swap: (swap == 0, f"{swap / 2**20:.0f} MiB in use"),
        "memory is short: end other programs, then sudo swapoff -a",
        "check with `free` that no swap is in use",
    )
    yield _check(
        "room for logs",
        host.free,
        lambda free: (free >= MIN_FREE_SPACE, f"{free / 2**30:.1f} GiB"),
        "a full disk ends a log, not a run: make room, or give another folder",
        "check the folder of the logs with `df`",
    )


def _check(
    name: str, reading: T | None, judge: Callable[[T], tuple[bool, str]], cure: str, unknown: str
) -> CheckResult:
    """Return the result for a reading that may be missing, with the cure for either case."""
    if reading is None:
        return CheckResult(name, "unknown", "cannot be read here", unknown)
    good, found = judge(reading)
    return rated(name, "good" if good else "warning", found, cure)


def check_realtime(settings: Iterable[RealtimeSetting]) -> Iterator[CheckResult]:
    """Judge which real-time settings the machine allows."""
    for one in settings:
        yield rated(one.name, "good" if one.taken else "warning", one.found, one.cure)


def _read(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return None


def _match(path: Path, pattern: str) -> str | None:
    """Return the group of a pattern, found in the lines of a file; None where it is missing."""
    found = re.search(pattern, _read(path) or "", re.MULTILINE)
    return found and found[1]


def _realtime(root: Path, version: str | None) -> bool | None:
    flag = _read(root / "sys/kernel/realtime")
    if flag is not None:
        return flag == "1"
    return None if version is None else re.search("PREEMPT[_ ]RT", version) is not None


def _cores(root: Path) -> int | None:
    allowed = _match(root / "proc/self/status", r"^Cpus_allowed_list:\s*(\S+)")
    if allowed is None:
        return None
    ends = [part.split("-") for part in allowed.split(",")]
    return sum(int(end[-1]) - int(end[0]) + 1 for end in ends)


def _governors(root: Path) -> tuple[str, ...] | None:
    files = (root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    names = {name for file in files if (name := _read(file))}
    return tuple(sorted(names)) or None


def _limit(root: Path, name: str) -> Limit:
    limit = _match(root / "proc/self/limits", rf"^{name}\s+(\S+)")
    if limit is None:
        return None
    return int(limit) if limit.isdecimal() else "unlimited"


def _swap(root: Path) -> int | None:
    table = _read(root / "proc/swaps")
    if table is None:
        return None
    # A header, then: file, kind, size and used in kB, priority.
    return 1024 * sum(int(line.split()[-2]) for line in table.splitlines()[1:])


def _hosts(root: Path) -> tuple[str, ...] | None:
    if _read(root / "proc/cpuinfo") is None:
        return None
    firmware = [_read(root / f"sys/class/dmi/id/{name}") for name in ("sys_vendor", "product_name")]
    virtual = (
        _match(root / "proc/cpuinfo", r"^flags\s*:.*\b(hypervisor)\b") is not None
        or (root / "sys/hypervisor/type").exists()
        or any(word in (name or "") for name in firmware for word in HYPERVISORS)
    )
    group = _read(root / "proc/1/cgroup") or ""
    marks = (".dockerenv", "run/.containerenv", "run/systemd/container")
    contained = any((root / mark).exists() for mark in marks) or any(
        word in group for word in CONTAINERS
    )
    return ("virtual machine",) * virtual + ("container",) * contained


def _networks(root: Path) -> dict[str, bool] | None:
    folder = root / "sys/class/net"
    if not folder.is_dir():
        return None
    # Loopback, bridges and tunnels have no device behind them.
    return {
        card.name: (card / "wireless").exists()
        for card in sorted(folder.iterdir())
        if (card / "device").exists() and _read(card / "operstate") == "up"
    }


def _free(folder: Path) -> int | None:
    place = folder.absolute()
    try:
        return shutil.disk_usage(next(one for one in (place, *place.parents) if one.exists())).free
    except OSError:
        return None
