"""The machine that a loop runs on, as its system describes it, and how to run something punctually.

Everything is read from `/proc` and `/sys`, and nothing is changed. What a system does not tell, as
macOS and many containers do not, stays None: it is not guessed.
"""

import ctypes
import gc
import platform
import re
import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, Literal, TypeVar

from equipoise.artefacts import Value
from equipoise.devices.realtime import RealtimeSetting, prepare

T = TypeVar("T")

Limit = int | Literal["unlimited"] | None
"""A limit of the system; None where it cannot be read."""

CONTAINERS: Final = ("docker", "kubepods", "containerd", "lxc", "libpod", "podman")
"""Words in the control group of the first process inside a container."""
HYPERVISORS: Final = ("QEMU", "KVM", "VMware", "VirtualBox", "Virtual Machine", "Xen", "EC2")
"""Words in what the firmware of a virtual machine calls itself or its maker."""


class HostInfo(Value):
    """What a machine says of itself."""

    system: str
    """Its operating system: Linux, Darwin, Windows."""
    kernel: str | None
    """Release of its kernel."""
    realtime: bool | None
    """Whether the kernel is PREEMPT_RT."""
    cores: int | None
    """Processor cores that this process may use."""
    governors: tuple[str, ...] | None
    """What chooses the clock rates of the cores, each name once."""
    rtprio: Limit
    """Highest real-time priority that this user may take."""
    memlock: Limit
    """Memory that this user may lock [B]."""
    load: float | None
    """Processes that ran or wanted to, mean over the last minute."""
    swap: int | None
    """Memory that lies in swap [B]."""
    hosts: tuple[str, ...] | None
    """Signs that something else schedules this machine: `virtual machine`, `container`."""
    networks: dict[str, bool] | None
    """Network cards that are in use, by name, and whether each is wireless."""
    free: int | None
    """Free space where logs go [B]."""


def read_host_info(logs: Path = Path(), *, root: Path = Path("/"), system: str = "") -> HostInfo:
    """Return what the machine says of itself.

    Args:
        logs: Folder where logs go; it need not exist yet.
        root: Where `proc` and `sys` are.
        system: Its operating system; the running one if not given.
    """
    version = _read(root / "proc/version")
    release = re.search(r"version (\S+)", version or "")
    here = root == Path("/")
    return HostInfo(
        system=system or platform.system(),
        kernel=release[1] if release else (platform.release() if here else None),
        realtime=_realtime(root, version),
        cores=_cores(root),
        governors=_governors(root),
        rtprio=_limit(root, "Max realtime priority"),
        memlock=_limit(root, "Max locked memory"),
        load=_load(root),
        swap=_swap(root),
        hosts=_hosts(root),
        networks=_networks(root),
        free=_free(logs),
    )


def run_with_realtime_priority(
    work: Callable[[], T], *, take: Callable[[], tuple[RealtimeSetting, ...]] = prepare
) -> tuple[T, tuple[RealtimeSetting, ...]]:
    """Run something on a thread of its own with all measures of a run, and undo them.

    Priority and core are the thread's own and end with it; garbage collection and the lock on the
    memory are the process's, and are put back.

    Args:
        work: What to run.
        take: Takes the measures.

    Returns:
        What came of it, and which measures the machine allowed.
    """
    done: list[tuple[T, tuple[RealtimeSetting, ...]]] = []
    failed: list[BaseException] = []

    def run() -> None:
        try:
            measures = take()
            done.append((work(), measures))
        except BaseException as error:
            failed.append(error)

    collects = gc.isenabled()
    thread = threading.Thread(target=run, daemon=True)
    try:
        thread.start()
        thread.join()
    finally:
        gc.unfreeze()
        if collects:
            gc.enable()
        with suppress(AttributeError, OSError, TypeError):
            ctypes.CDLL(None).munlockall()
    if failed:
        raise failed[0]
    return done[0]


def _read(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return None


def _realtime(root: Path, version: str | None) -> bool | None:
    said = _read(root / "sys/kernel/realtime")
    if said is not None:
        return said == "1"
    if version is None:
        return None
    return "PREEMPT_RT" in version or "PREEMPT RT" in version


def _cores(root: Path) -> int | None:
    found = re.search(r"^Cpus_allowed_list:\s*(\S+)", _read(root / "proc/self/status") or "", re.M)
    if found is None:
        return None
    ends = [part.split("-") for part in found[1].split(",")]
    return sum(int(end[-1]) - int(end[0]) + 1 for end in ends)


def _governors(root: Path) -> tuple[str, ...] | None:
    files = (root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    names = {name for file in files if (name := _read(file))}
    return tuple(sorted(names)) or None


def _limit(root: Path, name: str) -> Limit:
    found = re.search(rf"^{name}\s+(\S+)", _read(root / "proc/self/limits") or "", re.M)
    if found is None:
        return None
    return int(found[1]) if found[1].isdecimal() else "unlimited"


def _load(root: Path) -> float | None:
    said = (_read(root / "proc/loadavg") or "").split()
    return float(said[0]) if said else None


def _swap(root: Path) -> int | None:
    said = _read(root / "proc/swaps")
    if said is None:
        return None
    # A header, then: file, kind, size and used in kB, priority.
    return 1024 * sum(int(line.split()[-2]) for line in said.splitlines()[1:])


def _hosts(root: Path) -> tuple[str, ...] | None:
    processor = _read(root / "proc/cpuinfo")
    if processor is None:
        return None
    firmware = [_read(root / f"sys/class/dmi/id/{name}") for name in ("sys_vendor", "product_name")]
    virtual = (
        re.search(r"^flags\s*:.*\bhypervisor\b", processor, re.M) is not None
        or (root / "sys/hypervisor/type").exists()
        or any(word in (said or "") for said in firmware for word in HYPERVISORS)
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
    # What is no card (loopback, bridges, tunnels) has no device behind it.
    return {
        card.name: (card / "wireless").exists()
        for card in sorted(folder.iterdir())
        if (card / "device").exists() and _read(card / "operstate") == "up"
    }


def _free(folder: Path) -> int | None:
    place = folder.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    try:
        return shutil.disk_usage(place).free
    except OSError:
        return None
