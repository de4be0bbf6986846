"""Tests when a base station observed, by files written by hand as RINEX prescribes."""

from __future__ import annotations

import gzip
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from swath.daemon.errors import UserError
from swath.daemon.processing.landing.base import base_check, read_epochs, with_base
from swath.georef.timescales.gps_time import SECOND_NS

BEGIN = datetime(2026, 6, 15, 9, 0, tzinfo=UTC)
BEGIN_NS = 1_465_549_200 * SECOND_NS  # the same as GPS time: 2423 weeks, 1 day, 9 hours


def labelled(text: str, label: str) -> str:
    return f"{text:60}{label:20}\n"


def rinex(version: float, seconds: list[float], station: str = "ZIM2", system: str = "GPS") -> str:
    """Return a file of observations: header, epochs, a satellite's line each, and an event in between."""
    text = labelled(f"{version:9.2f}{'':11}OBSERVATION DATA    M", "RINEX VERSION / TYPE")
    text += labelled(station, "MARKER NAME") if station else ""
    text += labelled(f"{'':48}{system}", "TIME OF FIRST OBS") + labelled("", "END OF HEADER")
    for second in seconds:
        at = BEGIN + timedelta(seconds=second)
        part = at.second + at.microsecond * 1e-6
        if version < 3:
            text += (
                f" {at:%y} {at.month:2} {at.day:2} {at.hour:2} {at.minute:2}{part:11.7f}  0  1G12{'':40}-.123456789\n"
            )
            text += "  23629347.915            .300 8\n"
        else:
            text += f"> {at:%Y %m %d %H %M}{part:11.7f}  0  1      -0.123456789012\n"
            text += "G12  23629347.915            .300 8\n"
    return text + ("> 2030 01 01 00 00  0.0000000  4  1\n" if version >= 3 else "")


@pytest.mark.parametrize("version", [2.11, 3.05, 4.0])
@pytest.mark.parametrize(("system", "later_s"), [("GPS", 0), ("", 0), ("BDT", 14), ("GLO", 18)])
def test_epochs_are_those_of_the_file_in_gps_time(tmp_path: Path, version: float, system: str, later_s: int) -> None:
    seconds = [0.0, 1.0, 2.5, 3600.0]
    (tmp_path / "a.rnx").write_text(rinex(version, seconds, system=system))
    (tmp_path / "a.rnx.gz").write_bytes(gzip.compress(rinex(version, seconds, system=system).encode()))
    for name in ("a.rnx", "a.rnx.gz"):
        found = read_epochs(tmp_path / name)
        assert found.station == "ZIM2"
        assert (found.gps_ns - BEGIN_NS).tolist() == [round((second + later_s) * 1e9) for second in seconds]


def test_one_station_has_to_observe_the_whole_flight(tmp_path: Path) -> None:
    """Its hourly files count together; another station with a pause is named too."""
    flown_ns = BEGIN_NS + 600 * SECOND_NS, BEGIN_NS + 5000 * SECOND_NS
    seconds = np.arange(0.0, 7200.0, 10.0)
    hours = [seconds[:360].tolist(), seconds[360:].tolist()]
    for number, hour in enumerate(hours):
        (tmp_path / f"{number}.26o").write_text(rinex(2.11, hour))
    (tmp_path / "b.rnx").write_text(rinex(3.05, [*hours[0][100:200], *hours[0][300:]], station=""))
    first, second, other = (read_epochs(tmp_path / name) for name in ("0.26o", "1.26o", "b.rnx"))
    whole = base_check([first, other, second], flown_ns)
    assert whole.state == "good"
    assert whole.text == (
        "ZIM2: an epoch every 10 s, the whole flight; "
        "b.rnx: an epoch every 10 s, begins 400 s late and ends 1,410 s early and pauses, the longest of 1,010 s"
    )
    half = base_check([first], flown_ns)
    assert (half.state, half.text) == ("remark", "ZIM2: an epoch every 10 s, ends 1,410 s early")


def test_the_verdict_takes_what_the_files_say(tmp_path: Path) -> None:
    (tmp_path / "a.rnx").write_text(rinex(3.05, np.arange(0.0, 100.0).tolist()))
    titles = {"lines": ("Lines", "remark"), "base": ("Base data", "unknown"), "log": ("Log", "unknown")}
    checks = [
        {"code": code, "title": title, "state": state, "text": "", "details": ["kept"]}
        for code, (title, state) in titles.items()
    ]
    found = {"state": "home", "sentence": "", "checks": checks, "flown_gps_ns": [BEGIN_NS, BEGIN_NS + 99 * SECOND_NS]}
    told = with_base(found, [tmp_path / "a.rnx"])
    assert told["sentence"] == "You can go home. With remarks: lines. Not known: log"
    assert told["checks"][1] == {
        "code": "base", "title": "Base data", "state": "good", "details": ["kept"],
        "text": "ZIM2: an epoch every 1 s, the whole flight",
    }  # fmt: skip
    with pytest.raises(UserError, match="--base: nothing has been flown yet"):
        with_base(found | {"flown_gps_ns": None}, [tmp_path / "a.rnx"])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (b"", "is no RINEX file of observations; give a RINEX file of observations"),
        (f"{'1.0':20}{'COMPACT RINEX FORMAT':40}CRINEX VERS   / TYPE\n".encode(), "unpack it with CRX2RNX"),
        (labelled(f"{3.05:9.2f}{'':11}N: GNSS NAV DATA", "RINEX VERSION / TYPE").encode(), "is no RINEX file of obs"),
        (rinex(3.05, []).encode(), "holds no epoch"),
        (rinex(3.05, [0.0]).replace("2026 06 15", "2026 13 15").encode(), "an epoch has no date"),
        (gzip.compress(rinex(3.05, [0.0]).encode(), mtime=0)[:-20], "give a RINEX file"),
    ],
    ids=["empty", "compact", "navigation", "no epochs", "no date", "cut"],
)
def test_other_files_are_refused_in_one_line(tmp_path: Path, text: bytes, told: str) -> None:
    (tmp_path / "a.obs").write_bytes(text)
    with pytest.raises(UserError) as caught:
        read_epochs(tmp_path / "a.obs")
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="No such file"):
        read_epochs(tmp_path / "none.obs")
