"""Tests start-up messages by pyubx2 and the makers' documents, and answers found in devices' data."""

from __future__ import annotations

import gzip
import re

import pytest
from pyubx2 import SET, UBX_CONFIG_DATABASE, UBXMessage, UBXReader

from swath.drivers.framing.kinds import UBX_NAMES
from swath.drivers.gnss.novatel import layouts as novatel_layouts
from swath.drivers.gnss.novatel import startup as novatel_startup
from swath.drivers.gnss.sbf import frame as sbf_frame
from swath.drivers.gnss.sbf import startup as sbf_startup
from swath.drivers.gnss.ubx import startup as ubx_startup
from swath.drivers.gnss.ubx.startup import AckListener
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.startup import Answer, AnswerListener, StartupMessage, StartupOptions
from tests.drivers.recordings import FIXTURES

ACK = UBXMessage("ACK", "ACK-ACK", 0, clsID=0x06, msgID=0x8A).serialize()
NAK = UBXMessage("ACK", "ACK-NAK", 0, clsID=0x06, msgID=0x8A).serialize()
OTHER_ACK = UBXMessage("ACK", "ACK-ACK", 0, clsID=0x06, msgID=0x01).serialize()

# PolaRx5TR reference guide, 3.2.9 (setClockSyncThreshold) and Septentrio's ROS driver (telegram_handler.cpp)
SBF_COMMAND = "scst, msec1, on"
SBF_REPLY = b"$R: scst, msec1, on\r\n  ClockSyncThreshold, msec1, on\r\nCOM1>"
SBF_ERROR = b"$R? setGNSSAttitude: Argument 'Source' is invalid!\r\nCOM1>"


def settings(**setup: object) -> DeviceSettings:
    return DeviceSettings("gnss/rover", {"setup": setup})


def texts(messages: tuple[StartupMessage, ...]) -> list[str]:
    return [line for message in messages for line in message.lines]


def recording(name: str) -> bytes:
    data = (FIXTURES / name).read_bytes()
    return gzip.decompress(data) if name.endswith(".gz") else data


def heard(listener: AnswerListener, data: bytes, size: int) -> Answer | None:
    """Return the response found in data that arrive in reads of a size."""
    for start in range(0, len(data), size):
        answer = listener.hear(data[start : start + size])
        if answer is not None:
            return answer
    return listener.close()


def sbf_listener(text: str) -> AnswerListener:
    messages = sbf_startup.startup_messages(settings(), StartupOptions())
    return next(message for message in messages if message.lines == (text,)).listen()


class TestUbx:
    @pytest.mark.parametrize("port", ["UART1", "UART2", "USB"])
    @pytest.mark.parametrize("rate_hz", [1, 2, 5, 10, 20])
    @pytest.mark.parametrize("save", [False, True])
    def test_pyubx2_reads_back_the_displayed_keys_and_values(self, port: str, rate_hz: int, save: bool) -> None:
        options = StartupOptions(save=save, baud=460800)
        for message in ubx_startup.startup_messages(settings(port=port, rate_hz=rate_hz), options):
            parsed = UBXReader.parse(message.data, msgmode=SET)
            assert parsed.identity == "CFG-VALSET"
            assert (parsed.version, parsed.ram, parsed.bbr, parsed.flash) == (0, 1, 1, int(save))
            assert message.lines[0] == "UBX-CFG-VALSET RAM+BBR" + ("+Flash" if save else "")
            assert 1 <= len(message.lines) - 1 <= 64
            for line in message.lines[1:]:
                name, value = line.split(" = ")
                assert getattr(parsed, name.replace("-", "_")) == int(value), line
            known = [name for name in vars(parsed) if name.startswith("CFG_")]
            assert len(known) == len(message.lines) - 1

    def test_every_key_matches_the_interface_description_in_pyubx2(self) -> None:
        named = {name.replace("-", "_"): key for name, key, _ in ubx_startup.TIME_PULSE}
        for port, place in ubx_startup.PORT_PLACES.items():
            named |= {f"CFG_MSGOUT_UBX_{name}_{port}": key + place for name, key in ubx_startup.MESSAGE_RATES.items()}
            named[f"CFG_{port}OUTPROT_UBX"] = ubx_startup.UBX_OUTPUT[port]
        named |= {f"CFG_{port}_BAUDRATE": key for port, key in ubx_startup.BAUD_RATES.items()}
        assert named == {name: UBX_CONFIG_DATABASE[name][0] for name in named}

    def test_every_requested_message_has_a_ubx_name(self) -> None:
        names = {name.replace("-", "_") for name in UBX_NAMES.values()}
        assert set(ubx_startup.MESSAGE_RATES) <= names

    def test_rate_applies_to_positions_and_raw_measurements_are_sent_once_a_second(self) -> None:
        lines = texts(ubx_startup.startup_messages(settings(rate_hz=10), StartupOptions()))
        assert {"CFG-RATE-MEAS = 100", "CFG-RATE-NAV = 1", "CFG-RATE-TIMEREF = 1"} <= set(lines)
        assert "CFG-MSGOUT-UBX_NAV_PVT_UART1 = 1" in lines
        assert "CFG-MSGOUT-UBX_RXM_RAWX_UART1 = 10" in lines
        assert "CFG-MSGOUT-UBX_NAV_TIMELS_UART1 = 10" in lines

    def test_the_pulse_is_1_hz_gps_time_rising_and_only_with_valid_time(self) -> None:
        lines = texts(ubx_startup.startup_messages(settings(), StartupOptions()))
        shown = {line.split(" = ")[0]: int(line.split(" = ")[1]) for line in lines if " = " in line}
        assert shown["CFG-TP-PERIOD_LOCK_TP1"] == 1_000_000
        assert shown["CFG-TP-LEN_TP1"] == 0
        assert shown["CFG-TP-TIMEGRID_TP1"] == shown["CFG-TP-POL_TP1"] == shown["CFG-TP-ALIGN_TO_TOW_TP1"] == 1

    def test_the_moving_baseline_is_requested_with_a_second_antenna(self) -> None:
        assert "RELPOSNED" not in " ".join(texts(ubx_startup.startup_messages(settings(), StartupOptions())))
        both = DeviceSettings("gnss/rover", {"secondary_lever_arm_m": [0.0, 1.0, 0.0]})
        lines = texts(ubx_startup.startup_messages(both, StartupOptions()))
        assert "CFG-MSGOUT-UBX_NAV_RELPOSNED_UART1 = 1" in lines

    def test_raw_measurements_are_not_requested_with_raw_off(self) -> None:
        assert "RXM" not in " ".join(texts(ubx_startup.startup_messages(settings(raw=False), StartupOptions())))

    def test_usb_port_has_no_baud_rate(self) -> None:
        messages = ubx_startup.startup_messages(settings(port="USB"), StartupOptions(baud=460800))
        assert all(message.baud is None for message in messages)

    def test_an_unknown_port_is_refused(self) -> None:
        with pytest.raises(DriverSettingsError, match=r"setup\.port: got 'COM1', want one of: UART1, UART2, USB"):
            ubx_startup.startup_messages(settings(port="COM1"), StartupOptions())

    @pytest.mark.parametrize(("reply", "answer"), [(ACK, Answer(True)), (NAK, Answer(False, "UBX-ACK-NAK"))])
    def test_a_response_within_data_is_found_however_it_is_cut(self, reply: bytes, answer: Answer) -> None:
        data = recording("ubx/pygpsdata-NAVHPPOS.log.gz")[:3000]
        for size in (1, 7, 64, 4096):
            assert heard(AckListener(), data + OTHER_ACK + reply + data, size) == answer

    def test_data_without_a_response_gives_none(self) -> None:
        for path in sorted((FIXTURES / "ubx").glob("*.log.gz")):
            assert heard(AckListener(), gzip.decompress(path.read_bytes()), 4096) is None, path.name

    def test_a_damaged_response_and_one_to_another_message_are_ignored(self) -> None:
        damaged = ACK[:-1] + bytes([ACK[-1] ^ 1])
        assert heard(AckListener(), damaged + OTHER_ACK, 5) is None

    def test_a_response_after_a_false_sync_is_found_at_the_timeout(self) -> None:
        """A false sync holds back the bytes after it until the time is over."""
        listener = AckListener()
        assert listener.hear(b"\xb5b\x01\x07\x00\x10" + ACK) is None
        assert listener.close() == Answer(True)


class TestNovatel:
    def test_requested_logs_are_known_to_the_driver(self) -> None:
        options = StartupOptions()
        config = {"secondary_lever_arm_m": [0, 1, 0], "setup": {"rate_hz": 10}}
        messages = novatel_startup.startup_messages(DeviceSettings("gnss/rover", config), options)
        messages += novatel_startup.imu_startup_messages(settings(), options)
        logs = re.findall(r"^LOG (\w+)B (?:ONNEW|ONCHANGED|ONTIME \d)", "\n".join(texts(messages)), re.MULTILINE)
        assert len(logs) == len(messages) - 1
        layouts = {layout.name for layout in novatel_layouts.LAYOUTS.values()}
        decoded = {"TIME", "BESTPOS", "BESTVEL", "MARK1TIME", "MARK2TIME", "HEADING2", "RAWIMUSX", "INSPVAS", "INSPVAX"}
        assert decoded | {"INSCONFIG"} <= layouts & set(logs)
        raw = {log.split()[0].removesuffix("B") for log in novatel_startup.RAW_LOGS}
        assert set(logs) - raw <= layouts
        assert "LOG BESTPOSB ONTIME 0.1" in texts(messages)

    def test_the_baud_rate_is_set_first_and_saved_last(self) -> None:
        messages = novatel_startup.startup_messages(settings(), StartupOptions(save=True, baud=460800))
        assert messages[0].data == b"SERIALCONFIG THISPORT 460800 N 8 1 N OFF\r\n"
        assert (messages[0].baud, messages[-1].data, messages[-1].last) == (460800, b"SAVECONFIG\r\n", True)

    def test_a_named_port_is_refused(self) -> None:
        with pytest.raises(DriverSettingsError, match=r"setup\.port"):
            novatel_startup.startup_messages(settings(port="COM1"), StartupOptions())

    @pytest.mark.parametrize("name", ["novatel/bestpos.gps", "novatel/oemv_200911218.gps.gz"])
    def test_a_response_in_a_recording_is_found_however_it_is_cut(self, name: str) -> None:
        data = recording(name)
        first = data.index(b"<OK\r\n")
        for size in (1, 5, 4096):
            listener = novatel_startup.startup_messages(settings(), StartupOptions())[0].listen()
            assert heard(listener, data[: first + 5], size) == Answer(True)
            listener = novatel_startup.startup_messages(settings(), StartupOptions())[0].listen()
            assert heard(listener, data[max(0, first - 9000) : first + 4], size) is None

    def test_data_without_a_response_gives_none(self) -> None:
        for name in ("ins1.gps", "time.gps", "align.gps", "rxstatus.gps", "propak6-basic-fix.gps.gz"):
            listener = novatel_startup.startup_messages(settings(), StartupOptions())[0].listen()
            assert heard(listener, recording(f"novatel/{name}"), 4096) is None, name

    def test_a_refusal_gives_its_reason(self) -> None:
        listener = novatel_startup.startup_messages(settings(), StartupOptions())[0].listen()
        answer = heard(listener, recording("novatel/time.gps") + b"\r\n<ERROR:Invalid Message ID\r\n[COM1]", 3)
        assert answer == Answer(False, "Invalid Message ID")


class TestSbf:
    def test_requested_blocks_are_known_to_the_driver(self) -> None:
        config = {"secondary_lever_arm_m": [0, 1, 0], "setup": {"port": "USB1"}}
        messages = sbf_startup.startup_messages(DeviceSettings("gnss/rover", config), StartupOptions())
        messages += sbf_startup.imu_startup_messages(settings(port="USB1"), StartupOptions())
        streams = [text.split(", ") for text in texts(messages) if text.startswith("setSBFOutput, ")]
        assert [stream[1] for stream in streams] == [f"Stream{number}" for number in range(1, 7)]
        assert {stream[2] for stream in streams} == {"USB1"}
        blocks = [block for stream in streams for block in stream[3].split("+")]
        assert len(blocks) == len(set(blocks))
        assert set(blocks) <= set(sbf_frame.NAMES.values())
        assert [stream[4] for stream in streams] == ["OnChange", "msec200", "sec1", "msec200", "msec20", "OnChange"]

    def test_one_hertz_is_written_as_seconds(self) -> None:
        assert "EndOfPVT, sec1" in "\n".join(texts(sbf_startup.startup_messages(settings(rate_hz=1), StartupOptions())))

    def test_the_baud_rate_is_set_first_and_saved_last(self) -> None:
        messages = sbf_startup.startup_messages(settings(port="COM2"), StartupOptions(save=True, baud=460800))
        assert messages[0].data == b"setCOMSettings, COM2, baud460800, bits8, No, bit1, none\r\n"
        assert messages[-1].data == b"exeCopyConfigFile, Current, Boot\r\n"
        assert messages[-1].last

    def test_an_unknown_port_is_refused(self) -> None:
        with pytest.raises(
            DriverSettingsError, match=r"setup\.port: got 'UART1', want COM1 to COM4, USB1, USB2, IP10 to IP17"
        ):
            sbf_startup.startup_messages(settings(port="UART1"), StartupOptions())

    @pytest.mark.parametrize(
        ("reply", "answer"),
        [(SBF_REPLY, Answer(True)), (SBF_ERROR, Answer(False, "setGNSSAttitude: Argument 'Source' is invalid!"))],
    )
    def test_a_reply_is_complete_with_the_prompt(
        self, reply: bytes, answer: Answer, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sbf_startup, "PULSE", SBF_COMMAND)
        data = recording("sbf/pygpsdata_x5_time.log.gz")[:4000]
        for size in (1, 6, 4096):
            assert heard(sbf_listener(SBF_COMMAND), data + reply + data, size) == answer
            assert heard(sbf_listener(SBF_COMMAND), data + reply[:-1], size) is None

    def test_the_reply_to_another_command_is_ignored(self) -> None:
        assert heard(sbf_listener(sbf_startup.PULSE), SBF_REPLY, 4096) is None

    def test_data_without_a_reply_gives_none(self) -> None:
        for path in sorted((FIXTURES / "sbf").glob("*.gz")):
            data = gzip.decompress(path.read_bytes())
            assert heard(sbf_listener(sbf_startup.PULSE), data, 4096) is None, path.name
