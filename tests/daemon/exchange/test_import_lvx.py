"""Tests ``swath import`` of Livox Viewer's files: whose head is whose scanner, times, claims, damage."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path

import pytest

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.exchange.capture_files import ImportOptions
from swath.drivers.scanner.livox.layout import (
    IMU_1,
    NO_SYNC,
    PPS_GPS_1,
    encode_packet_1,
    utc_bytes,
)
from tests.daemon.commands import swath
from tests.daemon.exchange.builders import content_of, run_import, write_config
from tests.daemon.log_check import read_log
from tests.drivers.livox_cases import FILES
from tests.drivers.lvx_files import FileHead, lvx1_package, lvx2_package, lvx_file

S = 1_000_000_000
TURNED = 'installation = [[0, 0, 1], [0, -1, 0], [1, 0, 0]]\nprotocol = "{}"\ntransport = "udp:0.0.0.0:{}"\n'
CONFIG = '[session]\nname = "viewer"\ndirectory = "logs"\n'
AVIA, TELE = FileHead("3JEDHB300100641", 0, 7, (0, -90, 0, 0.25, 0, 0)), FileHead("0TFDFH600100511", 1, 2)
MID360, HAP = FileHead("47MDK4A0020123", 7, 9), FileHead("5BTKJ1E0010001", 8, 10)


def scanner(name: str, protocol: str, port: int, serial: str = "") -> str:
    """Return a section of a scanner."""
    return f'[scanner.{name}]\nserial = "{serial}"\n' + TURNED.format(protocol, port)


def write_files(folder: Path) -> tuple[Path, Path]:
    """Write a file of each kind, with the packets of the encoder's captures, two heads in each."""
    first, second = folder / "a.lvx", folder / "b.lvx2"
    packages = [lvx1_package(0, unit) for unit in FILES["avia"]()]
    packages.insert(1, lvx1_package(1, FILES["avia"]()[0]))
    first.write_bytes(lvx_file(1, [AVIA, TELE], [packages[:10], packages[10:]]))
    mid360 = [lvx2_package(7, unit) for unit in FILES["mid360"]()]
    hap = [lvx2_package(8, unit) for unit in FILES["hap"]()]
    second.write_bytes(lvx_file(2, [MID360, HAP], [mid360, hap]))
    return first, second


def test_the_log_holds_what_the_heads_sent(tmp_path: Path) -> None:
    """A head is found by its serial number, by its broadcast code (a digit longer), or as the only one of a kind."""
    first, second = write_files(tmp_path)
    sections = [
        scanner("tele", "livox-avia", 2, TELE.code[:-1].lower()),
        scanner("avia", "livox-avia", 1),
        scanner("top", "livox-mid360", 3),
        scanner("nose", "livox-hap", 4, HAP.code),
    ]
    config = write_config(tmp_path, CONFIG + "\n".join(sections))
    report, captures = run_import(
        config, [first, second], tmp_path / "logs", ImportOptions(start_ns={"": 1_800_000_000 * S})
    )
    assert [capture.tally.damage for capture in captures] == [0, 0]
    assert report.units == {
        "scanner/avia": len(FILES["avia"]()),
        "scanner/nose": len(FILES["hap"]()),
        "scanner/tele": 1,
        "scanner/top": len(FILES["mid360"]()),
    }
    content = content_of(tmp_path / "logs")
    assert [data for _, data, _ in content["/scanner/avia/raw"]] == FILES["avia"]()
    assert dict(content["/scanner/avia/raw"][0][2])["protocol"] == "livox-avia"
    decoded = json.loads(swath("info", "--json", str(tmp_path / "logs")).stdout)["sessions"][0]["sources"]
    for name in ("avia", "top", "nose"):
        assert decoded[f"scanner/{name}"]["decoded"]["bad_checksums"] == 0
        assert decoded[f"scanner/{name}"]["decoded"]["records"]["ScannerReturns"] > 200
        assert decoded[f"scanner/{name}"]["decoded"]["records"]["ImuSamples"] > 0


def test_a_head_that_is_not_told_apart_is_named_and_can_be_chosen(tmp_path: Path) -> None:
    first, second = write_files(tmp_path)
    config = write_config(tmp_path, CONFIG + scanner("front", "livox-avia", 1))
    start = {"scanner/front": 1_800_000_000 * S}
    with pytest.raises(UserError) as error:
        run_import(config, [first], tmp_path / "logs", ImportOptions(start_ns=start))
    assert str(error.value) == (
        f"{first}: holds {AVIA.code} (Livox Avia, livox-avia), {TELE.code} (Livox Tele-15, livox-avia), but the "
        f"configuration has scanner/front (livox-avia); give --source scanner/NAME:CODE={first}, or serial and "
        "protocol in [scanner.NAME]"
    )
    for named, problem in (
        (f"scanner/front={first}", f"give --source scanner/front:CODE={first}"),
        (f"scanner/front:X={first}", f"give --source scanner/front:CODE={first}"),
        (f"scanner/front:{MID360.code}={second}", 'has protocol "livox-mid360", but scanner/front "livox-avia"'),
    ):
        with pytest.raises(UserError) as error:
            run_import(config, [], tmp_path / "logs", ImportOptions([named], start))
        assert problem in str(error.value)
    with pytest.raises(UserError, match="was not set to UTC, and the file has no other times; give --start"):
        run_import(config, [], tmp_path / "logs", ImportOptions([f"scanner/front:{TELE.code}={first}"]))
    options = ImportOptions([f"scanner/front:{TELE.code}={first}"], start)
    report, [capture] = run_import(config, [], tmp_path / "logs", options)
    assert report.units == {"scanner/front": 1}
    assert capture.passed == {AVIA.code: len(FILES["avia"]())}


@pytest.mark.slow
def test_claims_and_damage_are_shown(tmp_path: Path) -> None:
    """A head set to UTC needs no start; the file is cut in its last package."""
    begun = dt.datetime(2026, 11, 27, 10, 0, 1, tzinfo=dt.UTC)
    sent = [encode_packet_1(IMU_1, PPS_GPS_1, utc_bytes(begun), [((0, 0, 0), (0, 0, 1))])]
    sent.append(encode_packet_1(0, NO_SYNC, 5, []))
    path = tmp_path / "cut.lvx"
    path.write_bytes(lvx_file(1, [AVIA], [[lvx1_package(0, one) for one in sent]])[:-1])
    write_config(tmp_path, CONFIG + scanner("front", "livox-avia", 1))
    run = ("import", str(tmp_path / "swath.toml"), str(path), "-o")
    result = swath(*run, str(tmp_path / "logs"))
    claim = f"{AVIA.code}: Livox Avia; the file claims roll 0.00°, pitch -90.00°, yaw 0.00°, "
    claim += "x 0.250 m, y 0.000 m, z 0.000 m"
    assert result.returncode == ExitCode.DAMAGE
    assert result.stderr == f"swath: {path}: ends in a package at byte 174; everything readable is in the log\n"
    assert result.stdout.splitlines()[:2] == [f"{path}: lvx, 1 units of scanner/front", f"  {claim}"]
    assert f"cut.lvx: 1 units of scanner/front; {claim}" in [
        one["text"] for one in read_log(tmp_path / "logs").events("capture_imported")
    ]
    [capture] = json.loads(swath(*run, str(tmp_path / "again"), "--json").stdout)["captures"]
    [head] = capture["heads"]
    assert (head["code"], head["protocol"], head["pitch_deg"], head["x_m"]) == (AVIA.code, "livox-avia", -90.0, 0.25)
