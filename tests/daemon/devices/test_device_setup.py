"""Tests `swath setup` on real ptys and UDP ports, with receivers that accept, refuse, stay silent or always send."""

from __future__ import annotations

import gzip
import json
import os
import termios
from pathlib import Path

import pytest
from pyubx2 import SET, UBXReader

from swath.daemon.cli import setup
from swath.daemon.config import parse_config
from swath.daemon.devices.setup import DeviceSetup, Outcome, apply_setup, plan_setup
from swath.daemon.errors import ExitCode, UserError
from swath.drivers.transports import spec as uri
from tests.daemon.commands import swath
from tests.daemon.receivers import (
    novatel_replies,
    receiver,
    septentrio_replies,
    split_lines,
    split_ubx,
    ubx_acknowledges,
    udp_receiver,
)
from tests.daemon.rig import Recorder, free_udp_port, session_table, wait_until

ROOT = Path(__file__).parents[3]
UBX_DATA = gzip.decompress((ROOT / "fixtures/ubx/pygpsdata-NAVHPPOS.log.gz").read_bytes())
NOVATEL_DATA = (ROOT / "fixtures/novatel/time.gps").read_bytes()
SBF_DATA = gzip.decompress((ROOT / "fixtures/sbf/pygpsdata_x5_time.log.gz").read_bytes())
TIMEOUT_S = 10.0  # a device that answers does so at once; the computer may be busy
SILENT_S = 4.0


def gnss(path: str, protocol: str, options: str = "", more: str = "") -> str:
    return f'[gnss.rover]\ntransport = "serial:{path}{options}"\nprotocol = "{protocol}"\n{more}'


def apply(
    text: str,
    folder: Path,
    *only: str,
    save: bool = False,
    present_baud: int | None = None,
    timeout_s: float = TIMEOUT_S,
) -> dict[str, DeviceSetup]:
    """Plan and send the messages; return the devices by source."""
    config = parse_config(session_table(folder) + text, folder / "swath.toml")
    wires = plan_setup(config, only, save=save, present_baud=present_baud)
    for wire in wires:
        apply_setup(wire, timeout_s)
    return {device.source: device for wire in wires for device in wire.devices}


def outcomes(device: DeviceSetup) -> list[Outcome]:
    return [step.outcome for step in device.steps]


def outcome_of(device: DeviceSetup, part: str) -> tuple[str, str]:
    """Return the outcome of the only message that contains a text, and the device's answer."""
    (step,) = [step for step in device.steps if any(part in line for line in step.message.lines)]
    return step.outcome, step.answer


class TestUbx:
    def test_all_messages_are_accepted_amid_ordinary_data(self, tmp_path: Path) -> None:
        with receiver(split_ubx, ubx_acknowledges(), UBX_DATA) as device:
            found = apply(gnss(device.path, "ubx"), tmp_path)["gnss/rover"]
        assert set(outcomes(found)) == {Outcome.ACCEPTED}
        assert found.ok
        assert device.commands == [step.message.data for step in found.steps]
        set_keys = {key for command in device.commands for key in vars(UBXReader.parse(command, msgmode=SET))}
        wanted = "NAV_PVT NAV_HPPOSLLH NAV_COV NAV_TIMEGPS NAV_TIMELS TIM_TP TIM_TM2 RXM_RAWX RXM_SFRBX"
        assert {f"CFG_MSGOUT_UBX_{name}_UART1" for name in wanted.split()} <= set_keys

    def test_a_refusal_does_not_stop_the_other_messages(self, tmp_path: Path) -> None:
        with receiver(split_ubx, ubx_acknowledges(refuses="TIM_TM2"), UBX_DATA) as device:
            found = apply(gnss(device.path, "ubx"), tmp_path)["gnss/rover"]
        assert outcome_of(found, "TIM_TM2") == (Outcome.REFUSED, "UBX-ACK-NAK")
        assert outcomes(found).count(Outcome.ACCEPTED) == len(found.steps) - 1
        assert not found.ok

    @pytest.mark.slow
    @pytest.mark.parametrize("chatter", [b"", UBX_DATA])
    def test_without_a_response_no_more_messages_are_sent(self, tmp_path: Path, chatter: bytes) -> None:
        with receiver(split_ubx, ubx_acknowledges(silent="RATE_MEAS"), chatter) as device:
            found = apply(gnss(device.path, "ubx"), tmp_path, timeout_s=SILENT_S)["gnss/rover"]
        assert outcome_of(found, "CFG-RATE-MEAS")[0] == Outcome.NO_ANSWER
        assert outcomes(found) == [Outcome.ACCEPTED, Outcome.NO_ANSWER, *[Outcome.NOT_SENT] * (len(found.steps) - 2)]
        assert len(device.commands) == 2

    @pytest.mark.slow
    def test_a_repeated_response_is_not_taken_for_the_next_message(self, tmp_path: Path) -> None:
        acknowledge = ubx_acknowledges(silent="RATE_MEAS")
        with receiver(split_ubx, lambda command: 2 * acknowledge(command)) as device:
            found = apply(gnss(device.path, "ubx"), tmp_path, timeout_s=SILENT_S)["gnss/rover"]
        assert outcomes(found)[:3] == [Outcome.ACCEPTED, Outcome.NO_ANSWER, Outcome.NOT_SENT]

    @pytest.mark.slow
    def test_the_line_follows_the_device_to_the_configured_rate(self, tmp_path: Path) -> None:
        acknowledge = ubx_acknowledges()

        def reply(command: bytes) -> bytes:
            keys = vars(UBXReader.parse(command, msgmode=SET))
            if "CFG_UART1_BAUDRATE" in keys and device.speed == termios.B38400:
                assert keys["CFG_UART1_BAUDRATE"] == 460800
                device.speed = termios.B460800
                return b""  # what it says while it changes is lost
            return acknowledge(command)

        with receiver(split_ubx, reply, UBX_DATA, termios.B38400) as device:
            text = gnss(device.path, "ubx", "?baud=460800")
            found = apply(text, tmp_path, present_baud=38400, timeout_s=SILENT_S)["gnss/rover"]
        assert set(outcomes(found)) == {Outcome.ACCEPTED}
        assert outcome_of(found, "CFG-UART1-BAUDRATE = 460800")[0] == Outcome.ACCEPTED

    @pytest.mark.slow
    def test_a_device_already_at_the_configured_rate_is_accepted(self, tmp_path: Path) -> None:
        with receiver(split_ubx, ubx_acknowledges(), UBX_DATA, termios.B460800) as device:
            text = gnss(device.path, "ubx", "?baud=460800")
            found = apply(text, tmp_path, present_baud=38400, timeout_s=SILENT_S)["gnss/rover"]
        assert set(outcomes(found)) == {Outcome.ACCEPTED}

    @pytest.mark.slow
    def test_a_device_at_another_rate_gives_no_response(self, tmp_path: Path) -> None:
        with receiver(split_ubx, ubx_acknowledges(), UBX_DATA, termios.B9600) as device:
            found = apply(gnss(device.path, "ubx", "?baud=460800"), tmp_path, timeout_s=SILENT_S)["gnss/rover"]
        assert outcomes(found)[0] == Outcome.NO_ANSWER
        assert device.commands == []


class TestNovatel:
    def test_the_imu_inside_the_stream_uses_the_receivers_wire_and_saving_comes_last(self, tmp_path: Path) -> None:
        imu = '[imu.main]\ntransport = "gnss:rover"\nprotocol = "novatel"\n'
        with receiver(split_lines, novatel_replies(), NOVATEL_DATA) as device:
            found = apply(gnss(device.path, "novatel") + imu, tmp_path, save=True)
        assert all(one.ok and set(outcomes(one)) == {Outcome.ACCEPTED} for one in found.values())
        assert device.commands[0] == b"PPSCONTROL ENABLE_FINETIME POSITIVE 1.0 1000"
        assert {b"LOG TIMEB ONTIME 1", b"LOG BESTPOSB ONTIME 0.2", b"LOG RAWIMUSXB ONNEW"} <= set(device.commands)
        assert device.commands.count(b"SAVECONFIG") == 1
        assert device.commands[-1] == b"SAVECONFIG"

    def test_settings_are_not_saved_unless_all_were_accepted(self, tmp_path: Path) -> None:
        with receiver(split_lines, novatel_replies(refuses=b"MARK2TIME"), NOVATEL_DATA) as device:
            found = apply(gnss(device.path, "novatel"), tmp_path, save=True)["gnss/rover"]
        assert outcome_of(found, "MARK2TIME") == (Outcome.REFUSED, "Invalid Message ID")
        assert outcome_of(found, "SAVECONFIG") == (Outcome.NOT_SENT, "the device did not accept every message")
        assert outcomes(found).count(Outcome.ACCEPTED) == len(found.steps) - 2
        assert b"SAVECONFIG" not in device.commands

    def test_messages_are_sent_by_udp(self, tmp_path: Path) -> None:
        port = free_udp_port()
        text = f'[gnss.rover]\ntransport = "udp:127.0.0.1:{port}?source=127.0.0.2&buffer_mb=1"\nprotocol = "novatel"\n'
        with udp_receiver(port, novatel_replies()) as commands:
            found = apply(text, tmp_path)["gnss/rover"]
        assert set(outcomes(found)) == {Outcome.ACCEPTED}
        assert commands == [step.message.data.strip() for step in found.steps]

    @pytest.mark.parametrize("options", ["", "?source=127.0.0.2&group=239.74.163.9"])
    def test_a_device_without_an_address_cannot_be_configured(self, tmp_path: Path, options: str) -> None:
        text = f'[gnss.rover]\ntransport = "udp:127.0.0.1:{free_udp_port()}{options}"\nprotocol = "novatel"\n'
        found = apply(text, tmp_path)["gnss/rover"]
        assert found.problem.endswith("add ?source=<its address> and remove group")
        assert set(outcomes(found)) == {Outcome.NOT_SENT}


class TestSbf:
    def test_all_messages_are_accepted_and_the_ins_uses_the_receivers_port(self, tmp_path: Path) -> None:
        more = (
            '[gnss.rover.setup]\nport = "COM2"\nrate_hz = 10\n[imu.main]\ntransport = "gnss:rover"\nprotocol = "sbf"\n'
        )
        with receiver(split_lines, septentrio_replies(), SBF_DATA) as device:
            found = apply(gnss(device.path, "sbf", more=more), tmp_path, save=True)
        assert all(one.ok and set(outcomes(one)) == {Outcome.ACCEPTED} for one in found.values())
        assert b"setSBFOutput, Stream2, COM2, PVTGeodetic+PosCovGeodetic+VelCovGeodetic+EndOfPVT, msec100" in (
            device.commands
        )
        assert device.commands[0] == b"setPPSParameters, sec1, Low2High, , GPS"
        assert b"setSBFOutput, Stream5, COM2, INSNavGeod, msec20" in device.commands
        assert device.commands[-1] == b"exeCopyConfigFile, Current, Boot"

    def test_a_refusal_gives_its_reason(self, tmp_path: Path) -> None:
        with receiver(split_lines, septentrio_replies(refuses=b"Stream3"), SBF_DATA) as device:
            found = apply(gnss(device.path, "sbf"), tmp_path)["gnss/rover"]
        assert outcome_of(found, "Stream3") == (Outcome.REFUSED, "setSBFOutput: Argument 'Stream' is invalid!")
        assert outcomes(found).count(Outcome.ACCEPTED) == len(found.steps) - 1


class TestPlan:
    def test_a_device_without_start_up_messages_is_reported(self, tmp_path: Path) -> None:
        found = apply(gnss("/dev/ttyS99", "nmea"), tmp_path)["gnss/rover"]
        assert (found.steps, found.problem, found.ok) == ([], "", True)

    def test_an_absent_device_is_one_line_and_nothing_is_sent(self, tmp_path: Path) -> None:
        found = apply(gnss(f"{tmp_path}/gone", "ubx"), tmp_path)["gnss/rover"]
        assert "does not exist" in found.problem
        assert set(outcomes(found)) == {Outcome.NOT_SENT}

    def test_one_device_of_several_can_be_chosen(self, tmp_path: Path) -> None:
        other = '[gnss.base]\ntransport = "serial:/dev/ttyS98"\nprotocol = "novatel"\n'
        with receiver(split_ubx, ubx_acknowledges()) as device:
            found = apply(gnss(device.path, "ubx") + other, tmp_path, "gnss/rover")
        assert list(found) == ["gnss/rover"]

    def test_an_unknown_device_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(UserError, match="no device gnss/base; there are: gnss/rover") as error:
            apply(gnss("/dev/ttyS99", "ubx"), tmp_path, "gnss/base")
        assert error.value.exit_code == ExitCode.USAGE

    def test_a_present_rate_needs_one_device_with_a_configured_rate(self, tmp_path: Path) -> None:
        with pytest.raises(UserError, match=r"one serial device with \?baud=…; no device has a baud rate"):
            apply(gnss("/dev/ttyS99", "ubx"), tmp_path, present_baud=9600)
        both = gnss("/dev/ttyS99", "ubx", "?baud=460800")
        both += '[gnss.base]\ntransport = "serial:/dev/ttyS98?baud=115200"\nprotocol = "novatel"\n'
        with pytest.raises(UserError, match="there are: gnss/rover, gnss/base; choose one with --device"):
            apply(both, tmp_path, present_baud=9600)


class TestCommand:
    def write(self, folder: Path, text: str) -> str:
        path = folder / "swath.toml"
        path.write_text(session_table(folder) + text)
        return str(path)

    def test_setup_shows_the_messages_and_opens_nothing(self, tmp_path: Path) -> None:
        run = swath("setup", self.write(tmp_path, gnss("/dev/ttyS99", "ubx", "?baud=460800")))
        assert run.returncode == ExitCode.OK
        lines = [line.strip() for line in run.stdout.splitlines()]
        assert lines[0] == "gnss/rover: ubx by serial:/dev/ttyS99?baud=460800"
        assert {"UBX-CFG-VALSET RAM+BBR", "CFG-RATE-MEAS = 200", "CFG-MSGOUT-UBX_NAV_PVT_UART1 = 1"} <= set(lines)
        assert lines[-1] == "nothing was sent; use --apply to send"

    def test_the_present_rate_has_the_bound_of_the_configured_one(self) -> None:
        assert setup.MAX_BAUD == uri.MAX_BAUD

    def test_setup_reports_the_outcome_of_each_message(self, tmp_path: Path) -> None:
        with receiver(split_lines, novatel_replies(refuses=b"RANGEB"), NOVATEL_DATA) as device:
            run = swath("setup", self.write(tmp_path, gnss(device.path, "novatel")), "--apply")
        assert run.returncode == ExitCode.PROBLEM
        assert "  accepted   LOG TIMEB ONTIME 1\n" in run.stdout
        assert "  refused    LOG RANGEB ONTIME 1 (Invalid Message ID)\n" in run.stdout
        assert run.stderr == ""

    def test_json_lists_the_outcomes(self, tmp_path: Path) -> None:
        with receiver(split_ubx, ubx_acknowledges(), UBX_DATA) as device:
            run = swath("setup", self.write(tmp_path, gnss(device.path, "ubx")), "--apply", "--save", "--json")
        assert run.returncode == ExitCode.OK
        found = json.loads(run.stdout)
        assert (found["applied"], found["ok"]) == (True, True)
        (rover,) = found["devices"]
        assert {message["outcome"] for message in rover["messages"]} == {"accepted"}
        assert [bytes.fromhex(message["hex"]) for message in rover["messages"]] == device.commands
        assert rover["messages"][0]["lines"] == ["UBX-CFG-VALSET RAM+BBR+Flash", "CFG-UART1OUTPROT-UBX = 1"]

    def test_beside_a_recorder_the_port_is_in_use(self, tmp_path: Path) -> None:
        with receiver(split_ubx, ubx_acknowledges(), UBX_DATA) as device:
            text = gnss(device.path, "ubx")
            with Recorder(tmp_path / "recorder", session_table(tmp_path / "logs") + text) as recorder:
                descriptors = Path(f"/proc/{recorder.process.pid}/fd")
                wait_until(  # realpath: a descriptor that is closed meanwhile is no error
                    lambda: any(os.path.realpath(link) == device.path for link in descriptors.iterdir()),
                    "the recorder has the port open",
                )
                run = swath("setup", self.write(tmp_path, text), "--apply")
        assert run.returncode == ExitCode.PROBLEM
        (line,) = [line for line in run.stdout.splitlines() if "in use" in line]
        assert line.strip().startswith(f"serial:{device.path}: {device.path} is in use by ")
        assert device.commands == []

    def test_a_wrong_port_is_a_configuration_error(self, tmp_path: Path) -> None:
        text = gnss("/dev/ttyS99", "ubx", more='[gnss.rover.setup]\nport = "COM1"\n')
        run = swath("check", "--offline", self.write(tmp_path, text))
        assert run.returncode == ExitCode.USAGE
        (line,) = run.stderr.splitlines()
        assert line.endswith("gnss.rover: setup.port: got 'COM1', want one of: UART1, UART2, USB")
