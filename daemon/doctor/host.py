"""Checks the computer itself: receive buffers, processor, memory, drivers."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Iterator
from pathlib import Path

from swath.daemon.doctor.finding import Finding, Tree, Verdict, read_text

RMEM_MAX_BYTES = 64 << 20  # the value in systemd/sysctl/90-swath.conf
FRAGMENTS_BYTES = 32 << 20
SLOW_IDLE_US = 50  # wake-up time from a sleep state, which delays the PPS interrupt
MEMORY_BYTES = 256 << 20  # the recorder's 64 MiB, a full queue of 64 MiB, and room for the kernel's buffers
DEBIAN_NAMES = {"x86_64": "amd64", "aarch64": "arm64", "armv7l": "armmp"}  # as kernel packages name processors
CLOSED_LOOP_DRIVERS = ("intel_pstate", "amd-pstate", "amd-pstate-epp")  # their "powersave" follows the load


def receive_buffers(tree: Tree, asked_bytes: int) -> Iterator[Finding]:
    """Check that the kernel grants the receive buffers that the scanners' sockets request.

    Args:
        asked_bytes: the largest buffer that is requested.
    """
    check = "receive buffers"
    limit = tree.number("/proc/sys/net/core/rmem_max")
    mend = f"sudo sysctl -w net.core.rmem_max={max(RMEM_MAX_BYTES, asked_bytes)}  # permanently: sysctl.d/90-swath.conf"
    if limit is None:
        yield Finding(check, Verdict.NOTE, "net.core.rmem_max cannot be read")
    elif limit < asked_bytes:
        text = f"net.core.rmem_max is {limit}, but the recorder needs {asked_bytes}: bursts and stalls lose data"
        yield Finding(check, Verdict.WRONG, text, mend)
    else:
        yield Finding(check, Verdict.OK, f"net.core.rmem_max is {limit}, the recorder needs {asked_bytes}")
    fragments = tree.number("/proc/sys/net/ipv4/ipfrag_high_thresh")
    if fragments is not None and fragments < FRAGMENTS_BYTES:
        text = f"net.ipv4.ipfrag_high_thresh is {fragments}: datagrams above the MTU may be lost in bursts"
        mend = f"sudo sysctl -w net.ipv4.ipfrag_high_thresh={FRAGMENTS_BYTES}  # permanently: sysctl.d/90-swath.conf"
        yield Finding("fragments", Verdict.NOTE, text, mend)


def dropped_datagrams(tree: Tree) -> Iterator[Finding]:
    """Report how many datagrams the kernel has dropped since its start because a receive buffer was full
    (RcvbufErrors).
    """
    lines = [line.split() for line in (tree.read("/proc/net/snmp") or "").splitlines() if line.startswith("Udp:")]
    if len(lines) < 2 or "RcvbufErrors" not in lines[0]:
        return
    dropped = int(dict(zip(lines[0], lines[1], strict=False))["RcvbufErrors"])
    if dropped:
        text = f"the kernel dropped {dropped} datagrams since the computer started (of any program)"
        yield Finding("receive buffers", Verdict.NOTE, text, "nstat -az UdpRcvbufErrors  # is the count still rising?")


def governor(tree: Tree) -> Iterator[Finding]:
    """Check whether the processor may run at its highest frequency."""
    check = "CPU governor"
    folders = sorted(tree.at("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq"))
    found = {(_word(folder / "scaling_governor"), _word(folder / "scaling_driver")) for folder in folders}
    mend = "sudo cpupower frequency-set -g performance"
    if not found:
        yield Finding(check, Verdict.OK, "the operating system does not control the processor's frequency")
    for name, driver in sorted(found):
        if name == "performance":
            yield Finding(check, Verdict.OK, name)
        elif name == "powersave" and driver not in CLOSED_LOOP_DRIVERS:
            text = f"{name} of {driver} keeps the processor at its lowest frequency: the recorder may fall behind"
            yield Finding(check, Verdict.WRONG, text, mend)
        else:
            text = f"{name} of {driver}: the frequency follows the load with some milliseconds of delay"
            yield Finding(check, Verdict.NOTE, text, mend)


def _word(path: Path) -> str:
    return read_text(path) or "?"


def idle_states(tree: Tree) -> Iterator[Finding]:
    """Check whether the processor enters sleep states so deep that a PPS interrupt is late."""
    slow: dict[str, int] = {}
    for folder in sorted(tree.at("/sys/devices/system/cpu").glob("cpu[0-9]*/cpuidle/state*")):
        latency, disabled = _word(folder / "latency"), _word(folder / "disable")
        if latency.isdecimal() and int(latency) > SLOW_IDLE_US and disabled != "1":
            slow[_word(folder / "name")] = int(latency)
    if slow:
        states = ", ".join(f"{name} {latency} µs" for name, latency in slow.items())
        text = f"waking up from {states} takes long: time stamps of edges are late by as much, and vary"
        yield Finding("PPS latency", Verdict.NOTE, text, f"sudo cpupower idle-set -D {SLOW_IDLE_US}")
    else:
        yield Finding("PPS latency", Verdict.OK, "no processor sleep state delays interrupts")


def memory(tree: Tree) -> Iterator[Finding]:
    """Check that there is memory for the queue and the kernel's buffers."""
    for line in (tree.read("/proc/meminfo") or "").splitlines():
        key, _, value = line.partition(":")
        if key == "MemAvailable":
            available = int(value.split()[0]) * 1024
            enough = available >= MEMORY_BYTES
            text = f"{available / 1e6:,.0f} MB available"
            mend = "" if enough else "stop other programs; ps aux --sort=-rss | head lists the largest"
            yield Finding("memory", Verdict.OK if enough else Verdict.WRONG, text, mend)


def modules(tree: Tree, needed: Iterable[str]) -> Iterator[Finding]:
    """Check that the drivers that the configuration needs are in the kernel, or can be loaded.

    Args:
        needed: names of modules, as modprobe knows them.
    """
    release = tree.read("/proc/sys/kernel/osrelease") or platform.release()
    for name in needed:
        if tree.at(f"/sys/module/{name}").exists() or name in _known(tree, release, "modules.builtin"):
            yield Finding("kernel modules", Verdict.OK, f"{name} is loaded")
            continue
        there = name in _known(tree, release, "modules.dep")
        text = f"{name} is not loaded" if there else f"{name} is not part of this kernel ({release})"
        load = f"sudo modprobe {name} && echo {name} | sudo tee /etc/modules-load.d/swath-{name}.conf"
        mend = load if there else f"install a kernel with {name}: on Debian {_debian_kernel(platform.machine())}"
        yield Finding("kernel modules", Verdict.WRONG, text, mend)


def _debian_kernel(machine: str) -> str:
    return f"linux-image-{DEBIAN_NAMES.get(machine, machine)}"


def _known(tree: Tree, release: str, index: str) -> set[str]:
    lines = (tree.read(f"/lib/modules/{release}/{index}") or "").splitlines()
    files = [line.partition(":")[0].rpartition("/")[2] for line in lines]
    return {file.partition(".ko")[0].replace("-", "_") for file in files}
