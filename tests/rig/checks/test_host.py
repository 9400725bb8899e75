"""Readings of a machine from made-up trees of /proc and /sys, and work under a run's measures."""

import gc
import threading

import pytest

from equipoise.rig.checks.host import read_host_info
from equipoise.rig.realtime import RealtimeSetting, run_with_realtime_priority

LIMITS = """Limit                     Soft Limit           Hard Limit           Units
Max locked memory         {memlock}              unlimited            bytes
Max realtime priority     {rtprio}                    99
"""
SWAPS = """Filename\t\t\t\tType\t\tSize\t\tUsed\t\tPriority
/dev/dm-2                               partition\t8388604\t\t{}\t\t-2
/swap file                              file\t\t1048572\t\t{}\t\t-3
"""
STOCK = (
    "Linux version 6.8.0-45-generic (buildd@host) (gcc 13.2.0) #45-Ubuntu SMP PREEMPT_DYNAMIC Fri"
)


@pytest.fixture
def root(tmp_path):
    """Return how to write files of a system, by path."""

    def write(files):
        for path, text in files.items():
            (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / path).write_text(text)
        return tmp_path

    return write


def linux(root, **files):
    return read_host_info(root=root(files), system="Linux")


def test_a_laboratory_machine_is_read_in_full(root, tmp_path):
    place = root(
        {
            "proc/version": "Linux version 6.8.1-1015-realtime (b@h) (gcc) #16 SMP PREEMPT_RT Tue",
            "sys/kernel/realtime": "1\n",
            "proc/self/status": "Name:\tpython\nCpus_allowed:\t3f\nCpus_allowed_list:\t0-3,6,8-9\n",
            "proc/self/limits": LIMITS.format(memlock="unlimited", rtprio=99),
            "proc/loadavg": "0.12 0.40 0.33 1/900 4711\n",
            "proc/swaps": SWAPS.format(0, 0),
            "proc/cpuinfo": "processor\t: 0\nflags\t\t: fpu vme sse\n",
            "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "performance\n",
            "sys/devices/system/cpu/cpu11/cpufreq/scaling_governor": "performance\n",
            "sys/class/dmi/id/sys_vendor": "Dell Inc.\n",
            "sys/class/net/eno1/operstate": "up\n",
            "sys/class/net/eno1/device/vendor": "0x8086\n",
        }
    )
    machine = read_host_info(tmp_path / "not" / "there", root=place, system="Linux")
    assert machine.system == "Linux"
    assert machine.kernel == "6.8.1-1015-realtime"
    assert machine.realtime is True
    assert machine.cores == 7
    assert machine.governors == ("performance",)
    assert (machine.rtprio, machine.memlock) == (99, "unlimited")
    assert machine.load == 0.12
    assert machine.swap == 0
    assert machine.hosts == ()
    assert machine.networks == {"eno1": False}
    assert machine.free is not None
    assert machine.free > 0


def test_what_a_system_does_not_tell_is_not_guessed(root):
    machine = read_host_info(root=root({}), system="Darwin")
    told = machine.model_dump(exclude={"system", "free"})
    assert set(told.values()) == {None}


@pytest.mark.parametrize(
    ("files", "realtime"),
    [
        ({"proc/version": STOCK}, False),
        ({"proc/version": STOCK, "sys/kernel/realtime": "1"}, True),
        ({"proc/version": STOCK, "sys/kernel/realtime": "0"}, False),
        ({"proc/version": "Linux version 6.12.9 (b@h) #1 SMP PREEMPT_RT Tue"}, True),
        ({"proc/version": "Linux version 4.19.0-rt (b@h) #1 SMP PREEMPT RT Tue"}, True),
    ],
)
def test_a_kernel_for_real_time_is_told_from_a_stock_one(root, files, realtime):
    assert linux(root, **files).realtime is realtime


def test_governors_are_named_once_each(root):
    cpu = "sys/devices/system/cpu"
    files = {
        f"{cpu}/cpu{k}/cpufreq/scaling_governor": name
        for k, name in enumerate(("powersave", "performance", "powersave"))
    }
    assert linux(root, **files).governors == ("performance", "powersave")


def test_limits_are_numbers_where_they_are_limited(root):
    machine = linux(root, **{"proc/self/limits": LIMITS.format(memlock=8388608, rtprio=0)})
    assert (machine.rtprio, machine.memlock) == (0, 8388608)


def test_swap_in_use_is_summed_up(root):
    assert linux(root, **{"proc/swaps": SWAPS.format(1024, 2)}).swap == 1026 * 1024
    assert linux(root, **{"proc/swaps": "Filename\tType\tSize\tUsed\tPriority\n"}).swap == 0


BARE = {"proc/cpuinfo": "flags\t: fpu\n"}


@pytest.mark.parametrize(
    ("files", "hosts"),
    [
        (BARE, ()),
        ({"proc/cpuinfo": "flags\t: fpu hypervisor lahf_lm\n"}, ("virtual machine",)),
        ({**BARE, "sys/class/dmi/id/sys_vendor": "QEMU"}, ("virtual machine",)),
        ({**BARE, "sys/hypervisor/type": "xen"}, ("virtual machine",)),
        ({**BARE, ".dockerenv": ""}, ("container",)),
        ({**BARE, "run/.containerenv": ""}, ("container",)),
        ({**BARE, "proc/1/cgroup": "0::/kubepods/pod1\n"}, ("container",)),
        ({**BARE, "proc/1/cgroup": "0::/init.scope\n"}, ()),
        (
            {"proc/cpuinfo": "flags\t: hypervisor", ".dockerenv": ""},
            ("virtual machine", "container"),
        ),
    ],
)
def test_a_virtual_machine_and_a_container_leave_signs(root, files, hosts):
    assert linux(root, **files).hosts == hosts


def test_only_cards_that_are_in_use_count_as_networks(root):
    net = "sys/class/net"
    files = {
        f"{net}/lo/operstate": "unknown",
        f"{net}/docker0/operstate": "up",
        f"{net}/eno1/operstate": "down",
        f"{net}/eno1/device/vendor": "",
        f"{net}/eno2/operstate": "up",
        f"{net}/eno2/device/vendor": "",
        f"{net}/wlan0/operstate": "up",
        f"{net}/wlan0/device/vendor": "",
        f"{net}/wlan0/wireless/link": "",
    }
    assert linux(root, **files).networks == {"eno2": False, "wlan0": True}


def test_work_runs_on_a_thread_of_its_own_and_leaves_the_process_as_it_was():
    measures = (RealtimeSetting("garbage collection", True, "off"),)
    here, collects = threading.get_ident(), gc.isenabled()

    def take():
        gc.freeze()
        gc.disable()
        return measures

    there, taken = run_with_realtime_priority(
        lambda: (threading.get_ident(), gc.isenabled()), take=take
    )
    assert there[0] != here
    assert there[1] is False
    assert taken == measures
    assert gc.isenabled() is collects
    assert gc.get_freeze_count() == 0


def test_an_error_in_work_reaches_the_caller():
    def work():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        run_with_realtime_priority(work, take=lambda: ())
    assert gc.isenabled()


def test_this_machine_is_read_without_an_error():
    machine = read_host_info()
    assert machine.free is not None
