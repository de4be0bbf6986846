"""Checks the wall clock: which program disciplines it, whether that may step it in flight, and how it moves now."""

from __future__ import annotations

import glob
import shlex
import time
from collections.abc import Iterator
from pathlib import PurePosixPath

from swath.daemon.doctor.finding import Finding, Tree, Verdict
from swath.daemon.log.host_clock import STEP_NOTICED_NS, ClockDiscipline, read_clock_pair, read_clock_sample

KEEPERS = {"chronyd": "chrony", "ntpd": "ntpd", "systemd-timesyn": "systemd-timesyncd", "openntpd": "openntpd"}
STEPPERS = ("systemd-timesyncd", "openntpd", "ntpd")  # these step the clock whenever it is far off
SLEWED_PPM = 150.0  # above an oscillator's own error and the 100 that chrony's drop-in permits
WATCH_S = 0.5
_CHRONY = "sudo apt-get install chrony  # with /etc/chrony/conf.d/swath.conf it steps at its start only"
_CONFIGURATIONS = ("/etc/chrony/chrony.conf", "/etc/chrony.conf")  # on Debian, on other systems
_INCLUDE_LEVELS = 10  # chrony follows no deeper nesting
_COMMENT = ("!", ";", "#", "%")


def keepers(tree: Tree, discipline: ClockDiscipline) -> Iterator[Finding]:
    """Check which program disciplines the wall clock, and whether it may step the clock while a flight is recorded."""
    check = "wall clock"
    found = sorted(KEEPERS[name] for name in tree.processes() & set(KEEPERS))
    if len(found) > 1:
        text = f"{' and '.join(found)} both set the clock and disturb each other"
        yield Finding(check, Verdict.WRONG, text, f"sudo systemctl disable --now {found[-1]}")
    for name in found:
        if name in STEPPERS:
            yield Finding(check, Verdict.WRONG, f"{name} may step the clock in flight", _CHRONY)
    if "chrony" in found:
        yield from chrony_steps(tree)
    if not discipline.disciplined:
        reason = "no program sets the clock" if not found else f"{found[0]} has not synchronised the clock yet"
        text = f"{reason}: it cannot name the second of a PPS edge, and it may be stepped later"
        yield Finding(check, Verdict.NOTE, text, _CHRONY if not found else "chronyc tracking; chronyc sources")
    elif not found:
        text = f"accurate to {discipline.max_error_s * 1e3:.1f} ms; the program that sets it is unknown"
        yield Finding(check, Verdict.OK, text)
    else:
        yield Finding(check, Verdict.OK, f"{found[0]} keeps it accurate to {discipline.max_error_s * 1e3:.1f} ms")


def chrony_steps(tree: Tree) -> Iterator[Finding]:
    """Check whether chrony's configuration lets it step the clock at any time (``makestep … -1``).

    The last ``makestep`` line is the one that chrony obeys.
    """
    makesteps = [(file, words) for file, words in _chrony_lines(tree) if words[0].lower() == "makestep"]
    file, words = makesteps[-1] if makesteps else ("", [])
    if len(words) > 2 and words[2].startswith("-"):
        text = f"{file} lets chrony step the clock at any time (makestep … -1)"
        anew = f"sudo sed -Ei 's/^\\s*makestep\\s.*/makestep 1 3/I' {shlex.quote(file)}"
        yield Finding("wall clock", Verdict.WRONG, text, f"{anew} && sudo systemctl restart chrony")


def _chrony_lines(tree: Tree) -> Iterator[tuple[str, list[str]]]:
    """Yield the lines of chrony's configuration as lists of words, each with its file, in the order in which chrony
    reads them.
    """
    configuration = next((path for path in _CONFIGURATIONS if tree.at(path).exists()), None)
    if configuration is not None:
        yield from _lines_of(tree, configuration, _INCLUDE_LEVELS)


def _lines_of(tree: Tree, file: str, levels: int) -> Iterator[tuple[str, list[str]]]:
    for line in (tree.read(file) or "").splitlines():
        words = line.split()
        if not words or words[0].startswith(_COMMENT):
            continue
        yield file, words
        for included in _included(tree, words) if levels else ():
            yield from _lines_of(tree, included, levels - 1)


def _included(tree: Tree, words: list[str]) -> list[str]:
    """Return the files that a line makes chrony read at that point.

    ``include`` names a pattern, ``confdir`` folders whose ``*.conf`` are read in the order of their names; of several
    files with one name, only the first folder's is read (chrony.conf(5)). ``sourcedir`` holds time sources and is not
    followed.
    """
    directive, *places = words
    match directive.lower():
        case "include" if places:
            return _files(tree, places[0])
        case "confdir":
            by_name: dict[str, str] = {}
            for place in places:
                for file in _files(tree, f"{glob.escape(place)}/*.conf"):
                    by_name.setdefault(PurePosixPath(file).name, file)
            return [by_name[name] for name in sorted(by_name)]
        case _:
            return []


def _files(tree: Tree, pattern: str) -> list[str]:
    return [f"/{path}" for path in sorted(glob.glob(pattern.lstrip("/"), root_dir=tree.root))]


def movement(step_ns: int, slew_ppm: float) -> Iterator[Finding]:
    """Report how the clocks moved while they were watched.

    Args:
        step_ns: how far CLOCK_REALTIME moved against CLOCK_MONOTONIC.
        slew_ppm: how much faster than its oscillator CLOCK_MONOTONIC went.
    """
    check = "clock movement"
    if abs(step_ns) > STEP_NOTICED_NS:
        text = f"the wall clock was stepped by {step_ns * 1e-9:+.6f} s during the check"
        mend = "stop the program that sets the clock: ps aux | grep -E 'ntp|chrony|timesync|gpsd'"
        yield Finding(check, Verdict.WRONG, text, mend)
    elif abs(slew_ppm) > SLEWED_PPM:
        text = f"the clock is being slewed by {slew_ppm:+.0f} ppm; wait until it is correct before a flight"
        yield Finding(check, Verdict.NOTE, text, "chronyc tracking")
    else:
        yield Finding(check, Verdict.OK, f"no step, {slew_ppm:+.1f} ppm against its oscillator")


def watch(seconds: float = WATCH_S) -> tuple[int, float]:
    """Return the step in nanoseconds and the slew in ppm of this computer's clocks over some seconds."""
    quiet = ClockDiscipline(0.0, 0, 0.0)
    pair, sample = read_clock_pair(), read_clock_sample(quiet)
    time.sleep(seconds)
    later_pair, later = read_clock_pair(), read_clock_sample(quiet)
    raw = int(later["monotonic_raw_ns"]) - int(sample["monotonic_raw_ns"])
    mono = int(later["monotonic_ns"]) - int(sample["monotonic_ns"])
    step_ns = later_pair.offset_ns - pair.offset_ns
    seen = abs(step_ns) > pair.width_ns + later_pair.width_ns  # an interrupted reading looks like a step
    return step_ns if seen else 0, (mono - raw) / raw * 1e6
