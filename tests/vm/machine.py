"""Runs a small virtual machine: the host's root read-only under a tmpfs, one command, its status.

`run` boots it, waits for the command and returns its status and output. `start` leaves it running, so that a test can
talk to it or cut its power. `/vm` in the machine is the folder ``shared`` of the host; the project's tree has the same
path as on the host.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
TREE = HERE.parent.parent
CACHE = HERE / ".cache"
GUEST = HERE / "guest"
MODULES = CACHE / "modules"  # pps_sim.ko
UDEV = CACHE / "udev"  # a layer, because the host may have no udev
DCD_SHIM = CACHE / "dcd_shim.so"

BOOT_S = 120.0  # twenty times what it takes on an idle machine
FIRST_WORD_S = 60.0  # from power on to VM-STAGE1, likewise
POWERED_ON = 3  # times that it is powered on at most, if it stands still before that
TIMED_OUT = 124
NO_STATUS = 125
SERVE = """\
exec 9<> <(:)  # a pipe in which nothing comes
for ((number = 1; ; number++)); do
    until [ -e /vm/ask/$number ]; do read -rt 0.1 -u 9; done
    (cd /; exec bash /vm/ask/$number) >/vm/answer/$number.output 2>&1 9<&- </dev/null
    echo $? >/vm/answer/new; mv /vm/answer/new /vm/answer/$number.status
done
"""  # a command for `start`: what `Machine.shell` asks, one after the other, until the power goes
stood_still: list[Path] = []  # their folders; told at the end of a run
_SYSTEMD = "/lib/systemd/systemd"
# modules that udev would load for processor and board, which takes an emulated processor seconds
_NOT_LOADED = (
    *("kvm", "kvm_amd", "kvm_intel", "acpi_cpufreq", "powernow_k8", "aesni_intel", "ghash_clmulni_intel"),
    *("crct10dif_pclmul", "crc32_pclmul", "sha512_ssse3", "ccp", "button", "psmouse", "pcspkr", "lpc_ich", "iTCO_wdt"),
    *("i2c_i801", "ahci", "libata"),
)


@dataclass(frozen=True)
class Finished:
    """The result of a command: its status (or `TIMED_OUT`, `NO_STATUS`), its output, the kernel's and systemd's."""

    status: int
    output: str
    console: str

    def check(self) -> Finished:
        """Return this if the status is 0.

        Raises:
            AssertionError: the status is another; the message has the last output.
        """
        assert self.status == 0, f"status {self.status}\n{self.output[-8000:]}\n--- console\n{self.console[-3000:]}"
        return self


@dataclass
class Machine:
    """A running virtual machine."""

    qemu: subprocess.Popen[bytes]
    shared: Path
    deadline_s: float = field(repr=False)
    _asked: int = 0

    def wakes(self) -> bool:
        """Return True when its first program has printed something or it has ended; False if neither is in time."""
        until_s = time.monotonic() + FIRST_WORD_S
        while self.qemu.poll() is None and "VM-STAGE1" not in self.console:
            if time.monotonic() > until_s:
                return False
            time.sleep(0.05)
        return True

    @property
    def output(self) -> str:
        """Return the output of the command so far."""
        return _text(self.shared / "output")

    @property
    def console(self) -> str:
        """Return the output of kernel, systemd and qemu so far."""
        return _text(self.shared / "console")

    def said(self, pattern: str, timeout_s: float = BOOT_S) -> re.Match[str]:
        """Wait until the command has printed something that matches the pattern.

        Raises:
            AssertionError: if this takes too long, or the machine has ended.
        """
        until_s = time.monotonic() + timeout_s
        while True:
            ended = self.qemu.poll() is not None
            found = re.search(pattern, self.output, re.MULTILINE)
            if found is not None:
                return found
            if ended or time.monotonic() > until_s:
                state = "ended without saying" if ended else f"did not say in {timeout_s:.0f} s"
                raise AssertionError(f"{state} {pattern!r}\n{self.output[-8000:]}\n--- console\n{self.console[-3000:]}")
            time.sleep(0.02)

    def shell(self, command: str, timeout_s: float = BOOT_S) -> Finished:
        """Run one more bash command in a machine whose own command is `SERVE`, and wait for it; any status will do.

        Raises:
            AssertionError: if the machine has ended, or the command takes too long.
        """
        self._asked += 1
        asked, answered = self.shared / "ask", self.shared / "answer"
        new = asked / "new"
        new.write_text(command + "\n")
        new.rename(asked / str(self._asked))
        until_s = time.monotonic() + timeout_s
        status = answered / f"{self._asked}.status"
        while not status.exists():
            ended = self.qemu.poll() is not None
            if ended or time.monotonic() > until_s:
                said = _text(answered / f"{self._asked}.output")
                state = "the machine ended" if ended else f"no end in {timeout_s:.0f} s"
                raise AssertionError(f"{state}: {command}\n{said[-4000:]}\n--- console\n{self.console[-3000:]}")
            time.sleep(0.02)
        return Finished(int(status.read_text()), _text(answered / f"{self._asked}.output"), "")

    def told(self, command: str, timeout_s: float = BOOT_S) -> str:
        """Return the output of a command in a `SERVE` machine without the last line end; its status must be 0."""
        done = self.shell(command, timeout_s)
        assert done.status == 0, f"status {done.status}: {command}\n{done.output[-8000:]}"
        return done.output.rstrip("\n")

    def until(self, command: str, timeout_s: float = BOOT_S) -> None:
        """Wait in a `SERVE` machine until a command's status is 0."""
        loop = f"end=$((SECONDS + {timeout_s:.0f})); until {{ {command}; }} >/tmp/until 2>&1; do "
        done = self.shell(loop + "[ $SECONDS -lt $end ] || { cat /tmp/until; exit 1; }; sleep 0.2; done", 2 * timeout_s)
        assert done.status == 0, f"not within {timeout_s:.0f} s: {command}\n{done.output[-4000:]}"

    def kill(self) -> None:
        """Cut the power: what the machine has not written to its disks is gone."""
        self.qemu.kill()
        self.qemu.wait()

    def wait(self) -> Finished:
        """Wait for the machine's end, and end it when its time is up."""
        try:
            self.qemu.wait(max(0.0, self.deadline_s - time.monotonic()))
            status_text = _text(self.shared / "status").strip()
            status = int(status_text) if status_text else NO_STATUS
        except subprocess.TimeoutExpired:
            self.kill()
            status = TIMED_OUT
        return Finished(status, self.output, self.console)

    def __enter__(self) -> Machine:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


def run(
    command: str,
    *,
    shared: Path,
    systemd: bool = False,
    overlay: Path | None = None,
    layers: Sequence[Path] = (),
    qemu: Sequence[str | Path] = (),
    kernel: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
    memory_mb: int = 1024,
    timeout_s: float = BOOT_S,
) -> Finished:
    """Boot, run a bash command as root, and power off; see `start`."""
    with start(
        command,
        shared=shared,
        systemd=systemd,
        overlay=overlay,
        layers=layers,
        qemu=qemu,
        kernel=kernel,
        environment=environment,
        memory_mb=memory_mb,
        timeout_s=timeout_s,
    ) as machine:
        return machine.wait()


def start(
    command: str,
    *,
    shared: Path,
    systemd: bool = False,
    overlay: Path | None = None,
    layers: Sequence[Path] = (),
    qemu: Sequence[str | Path] = (),
    kernel: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
    memory_mb: int = 1024,
    timeout_s: float = BOOT_S,
) -> Machine:
    """Boot and run a bash command as root.

    An emulated machine may hang while its kernel starts (README, pitfalls); if no program has run yet, it is
    powered on again, and `stood_still` reports it.

    Args:
        command: bash command, run in the project's tree.
        shared: the host's folder for ``/vm``; receives ``output``, ``console`` and, with systemd, ``journal``.
        systemd: True if PID 1 is systemd, and the command runs after multi-user.target.
        overlay: files copied over the machine's root before PID 1; enabled units belong here.
        layers: folders or ext4 images, read-only, between ``overlay`` and the host's root, the first uppermost.
        qemu: further arguments of qemu; a network, a disk, a serial line.
        kernel: text added to the kernel's command line.
        environment: further variables of qemu's environment.
        memory_mb: memory, of which three quarters may hold files.
        timeout_s: seconds after which the machine is killed.
    """
    needed = [CACHE / "kernel/boot/vmlinux", CACHE / "initramfs.gz"]
    if shutil.which("qemu-system-x86_64") is None or not all(path.exists() for path in needed):
        pytest.fail("there is no qemu or no kernel for it: make test-vm installs them (tests/vm/setup.sh)")
    _prepare(shared, command, overlay, systemd)
    init = _SYSTEMD if systemd else "/vm/stage2"
    modules = (CACHE / "kernel").resolve() / "lib/modules"
    parameters = [
        "console=ttyS0 quiet panic=-1 mitigations=off tsc=reliable clocksource=tsc init_on_alloc=0",
        f"module_blacklist={','.join(_NOT_LOADED)}",
        f"vm.init={init} vm.modules={modules} vm.tree={TREE} vm.layers={len(layers)}",
        *(["systemd.unit=vm.target systemd.show_status=0"] if systemd else []),
        *kernel,
    ]
    arguments = ["-kernel", needed[0], "-initrd", needed[1], "-append", " ".join(parameters)]
    for tag, folder, more in [
        ("hostroot", Path("/"), ",readonly=on,multidevs=remap"),
        ("vm", shared, ""),
        *((f"layer{number}", layer, ",readonly=on") for number, layer in enumerate(layers) if layer.is_dir()),
    ]:
        arguments += ["-fsdev", f"local,id={tag},path={folder},security_model=none{more}"]
        arguments += ["-device", f"virtio-9p-pci,fsdev={tag},mount_tag={tag}"]
    board = "q35,usb=off,sata=off,smbus=off"
    computer = ["-M", board, "-smp", "2", "-m", str(memory_mb), "-display", "none", "-serial", "stdio"]
    fixed = ["-nodefaults", "-no-user-config", "-no-reboot", "-device", "virtio-rng-pci"]
    # setpriv ends the machine if the test run is killed
    line = [
        *("setpriv", "--pdeathsig", "KILL", "qemu-system-x86_64"),
        *_accelerator(),
        *computer,
        *fixed,
        *arguments,
        *qemu,
        *(word for number, layer in enumerate(layers) if layer.is_file() for word in _image(number, layer)),
    ]
    words = [str(word) for word in line]
    for number in range(1, POWERED_ON + 1):
        machine = _power_on(words, shared, environment or {}, timeout_s)
        if machine.wakes() or number == POWERED_ON:
            break
        machine.kill()
        stood_still.append(shared)
    return machine


def _image(number: int, path: Path) -> list[str]:
    """Return qemu's arguments for a disk that comes after those of a test, which are vda, vdb, …"""
    return [
        *("-drive", f"if=none,id=layer{number},format=raw,file={path},readonly=on,cache=unsafe"),
        *("-device", f"virtio-blk-pci,drive=layer{number},serial=layer{number},addr={0x1D - number:#x}"),
    ]


def _power_on(line: list[str], shared: Path, environment: Mapping[str, str], timeout_s: float) -> Machine:
    with (shared / "console").open("wb") as console:
        process = subprocess.Popen(
            line,
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=subprocess.STDOUT,
            env={**os.environ, **environment},
        )
    return Machine(process, shared, time.monotonic() + timeout_s)


def make_disk(path: Path, size_mb: int) -> Path:
    """Make an empty ext4 file system in a file, for `disk`."""
    path.unlink(missing_ok=True)
    subprocess.run(["mkfs.ext4", "-qF", str(path), f"{size_mb}M"], check=True, capture_output=True, env=with_sbin())
    return path


def disk(path: Path) -> list[str]:
    """Return qemu's arguments for a virtio disk; at a power cut, the file has exactly what the machine flushed."""
    return ["-drive", f"if=virtio,format=raw,file={path},cache=writeback"]


def replay_journal(path: Path) -> None:
    """Replay the journal of an ext4 file system as the next mount would, and check it completely.

    Raises:
        AssertionError: it is damaged beyond that.
    """
    found = subprocess.run(["e2fsck", "-fy", str(path)], capture_output=True, text=True, env=with_sbin(), check=False)
    assert found.returncode in (0, 1), found.stdout + found.stderr


def copy_from_disk(path: Path, source: str, folder: Path) -> None:
    """Copy a folder out of an ext4 file system without mounting it; ``source`` as ``/logs``."""
    folder.mkdir(parents=True, exist_ok=True)
    request = f"rdump {source} {folder}"
    found = subprocess.run(
        ["debugfs", "-R", request, str(path)], capture_output=True, text=True, env=with_sbin(), check=True
    )
    assert "not found" not in found.stderr, found.stderr


def quoted_python(script: Path, *arguments: str) -> str:
    """Return a command that runs a script with this process's Python, for the machine without systemd."""
    return shlex.join([sys.executable, str(script), *arguments])


def _prepare(shared: Path, command: str, overlay: Path | None, systemd: bool) -> None:
    shared.mkdir(parents=True, exist_ok=True)
    for name in ("status", "output", "console", "journal"):
        (shared / name).unlink(missing_ok=True)
    for name in ("root", "ask", "answer"):
        shutil.rmtree(shared / name, ignore_errors=True)
    for name in ("ask", "answer"):
        (shared / name).mkdir()
    shutil.copy(GUEST / "stage2", shared / "stage2")
    (shared / "stage2").chmod(0o755)
    (shared / "command").write_text(f"cd {shlex.quote(str(TREE))}\n{command}\n")
    root = shared / "root"
    if overlay is not None:
        shutil.copytree(overlay, root, symlinks=True)
    if systemd:
        units = root / "etc/systemd/system"
        units.mkdir(parents=True, exist_ok=True)
        for name in (GUEST / "masked").read_text().split():
            if not (units / name).is_symlink():
                (units / name).symlink_to("/dev/null")
        generators = root / "etc/systemd/system-generators"
        generators.mkdir(parents=True)
        for path in Path("/lib/systemd/system-generators").iterdir():
            if path.name != "systemd-fstab-generator":
                (generators / path.name).symlink_to("/dev/null")
        for unit in ("vm.target", "vm-command.service"):
            shutil.copy(GUEST / unit, units / unit)
        (units / "systemd-udev-trigger.service.d").mkdir()
        shutil.copy(GUEST / "coldplug.conf", units / "systemd-udev-trigger.service.d")
    for folder in (root, *(path for path in root.rglob("*") if path.is_dir() and not path.is_symlink())):
        if folder.exists():
            folder.chmod(folder.stat().st_mode | 0o055)  # folders made in a temporary one would lock users out


def _accelerator() -> list[str]:
    """Return qemu's arguments for KVM if the processor has it; a /dev/kvm without it opens, but is slower than TCG."""
    flags = re.search(r"^flags.*\b(vmx|svm)\b", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    if flags and os.access("/dev/kvm", os.W_OK):
        return ["-accel", "kvm", "-cpu", "host"]
    return ["-accel", "tcg,thread=multi", "-cpu", "max"]


def with_sbin() -> dict[str, str]:
    """Return an environment for programs that are not on everybody's PATH."""
    return {**os.environ, "PATH": f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"}


def _text(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""
