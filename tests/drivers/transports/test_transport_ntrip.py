"""Tests the NTRIP client against a caster on a real socket: both versions, chunks, refusals, losses, every byte."""

from __future__ import annotations

import base64
import datetime as dt
import socket
import threading
import time

import pynmea2
import pytest

from swath.drivers.transports import tcp_socket
from swath.drivers.transports.base import Transport, TransportError
from swath.drivers.transports.ntrip import NtripTransport, gga_sentence
from swath.drivers.transports.opening import open_transport
from swath.drivers.transports.spec import TransportSpec, parse_transport
from tests.drivers.caster import Caster, Script, caster, listen

DATA = bytes(range(256)) * 20
ICY = b"ICY 200 OK\r\n\r\n"
V2 = b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\nContent-Type: gnss/data\r\n\r\n"
CHUNKED = V2.replace(b"\r\n\r\n", b"\r\nTransfer-Encoding: chunked\r\n\r\n")
TABLE = (
    b"CAS;rtk2go.com;2101;x\r\nSTR;ZIMM0;Zimmerwald;RTCM 3.2;1005(10)\r\nSTR;NEAR;Near;RTCM 3.2;1005(10)\r\n"
    b"ENDSOURCETABLE\r\n"
)


def transport(found: Caster, options: str = "", mountpoint: str = "ZIMM0") -> Transport:
    return open_transport(parse_transport(f"ntrip:127.0.0.1:{found.port}/{mountpoint}{options}"))


def received(one: Transport, count: int) -> bytes:
    """Return so many bytes, or those that arrived in 20 s."""
    data, deadline_s = b"", time.monotonic() + 20.0
    while len(data) < count and time.monotonic() < deadline_s:
        for block in one.receive(0.2):
            assert block.kernel_realtime_ns is None
            data += block.units.tobytes()
    return data


def saying(*parts: bytes, hold: threading.Event | None = None) -> Script:
    def script(sock: socket.socket, number: int) -> None:
        for part in parts:
            sock.sendall(part)
            time.sleep(0.02)
        if hold is not None:
            hold.wait(20.0)

    return script


def chunks(data: bytes, size: int) -> bytes:
    parts = [data[at : at + size] for at in range(0, len(data), size)]
    return b"".join(b"%x;part=1\r\n%s\r\n" % (len(part), part) for part in parts)


@pytest.mark.slow
@pytest.mark.parametrize(
    "parts",
    [
        (ICY + DATA,),
        (b"ICY 200 OK\r\n", DATA),
        (ICY[:5], ICY[5:], DATA[:1], DATA[1:]),
        (V2 + DATA,),
        (V2[:30], V2[30:-1], V2[-1:] + DATA),
        (CHUNKED + chunks(DATA, 1000),),
        (CHUNKED, *(chunks(DATA, 77)[at : at + 13] for at in range(0, 2000, 13)), chunks(DATA, 77)[2002:]),
    ],
    ids=["v1", "v1 without empty line", "v1 in pieces", "v2", "v2 in pieces", "chunked", "chunked in pieces"],
)
def test_data_arrive_completely(parts: tuple[bytes, ...]) -> None:
    hold = threading.Event()
    with caster(saying(*parts, hold=hold)) as found:
        one = transport(found)
        one.open()
        assert received(one, len(DATA)) == DATA
        assert one.receive(0.05) == []
        hold.set()
        with pytest.raises(TransportError, match="the caster closed the connection"):
            received(one, 1)
        one.close()


def test_the_request_follows_ntrip_version_2(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CASTER_PASSWORD", "geheim:ü")
    with caster(saying(V2)) as found:
        one = transport(found, "?user=anna&password_env=CASTER_PASSWORD")
        one.open()
        one.close()
        (head,) = found.requests
    lines = head.split("\r\n")
    assert lines[0] == "GET /ZIMM0 HTTP/1.1"
    assert lines[1:4] == [f"Host: 127.0.0.1:{found.port}", "Ntrip-Version: Ntrip/2.0", "Connection: close"]
    assert any(line.startswith("User-Agent: NTRIP ") for line in lines)
    (secret,) = [line.split()[2] for line in lines if line.startswith("Authorization: Basic ")]
    assert base64.b64decode(secret).decode() == "anna:geheim:ü"


def test_the_version_1_request_names_no_other_version() -> None:
    with caster(saying(ICY)) as found:
        one = transport(found, "?version=1")
        one.open()
        one.close()
    assert found.requests[0].startswith("GET /ZIMM0 HTTP/1.0\r\n")
    assert "Ntrip-Version" not in found.requests[0]
    assert "Authorization" not in found.requests[0]


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (b"HTTP/1.1 401 Unauthorized\r\n\r\n", "the caster rejects user or password; check user and password_env"),
        (b"HTTP/1.0 404 Not Found\r\nServer: x\r\n\r\n", "the caster has no such mountpoint"),
        (b"SOURCETABLE 200 OK\r\nContent-Type: text/plain\r\n\r\n" + TABLE, "no mountpoint FAR; it has: ZIMM0, NEAR"),
        (b"SOURCETABLE 200 OK\r\n" + TABLE, "no mountpoint FAR; it has: ZIMM0, NEAR"),
        (
            b"HTTP/1.1 200 OK\r\nContent-Type: gnss/sourcetable\r\n\r\n" + TABLE,
            "no mountpoint FAR; it has: ZIMM0, NEAR",
        ),
        (b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n\r\n<html>", "check that this is an NTRIP caster"),
        (b"HTTP/1.1 302 Found\r\n\r\n", "answers HTTP/1.1 302 Found; check that this is an NTRIP caster"),
        (b"SSH-2.0-OpenSSH_9.2\r\n\r\n", "answers SSH-2.0-OpenSSH_9.2; check that this is an NTRIP caster"),
        (b"\x1b[31m\x00\r\n\r\n", "answers ·[31m·; check that this is an NTRIP caster"),
        (b"", "closed the connection without an answer"),
    ],
)
def test_refusals_are_reported_in_one_line(answer: bytes, said: str) -> None:
    with caster(saying(answer)) as found:
        with pytest.raises(TransportError) as caught:
            transport(found, mountpoint="FAR").open()
    text = str(caught.value)
    assert said in text
    assert text.startswith(f"ntrip:127.0.0.1:{found.port}/FAR: ")
    assert text.isprintable()


def test_a_listed_mountpoint_that_is_refused_is_explained() -> None:
    with caster(saying(b"SOURCETABLE 200 OK\r\n\r\n" + TABLE)) as found:
        with pytest.raises(TransportError, match="check that this user may read it"):
            transport(found).open()


def test_a_closed_port_and_an_unknown_host_raise_transport_errors() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(TransportError, match=f"refuses port {port}"):
        open_transport(parse_transport(f"ntrip:127.0.0.1:{port}/A")).open()
    with pytest.raises(TransportError, match=r"the host name caster\.invalid is unknown"):
        open_transport(parse_transport("ntrip:caster.invalid:2101/A")).open()


def test_a_host_name_that_cannot_be_encoded_is_refused_in_one_line() -> None:
    one = NtripTransport(TransportSpec("ntrip", "a..b:2101/ZIMM0"))
    with pytest.raises(TransportError, match=r"ntrip:a\.\.b:2101/ZIMM0: a\.\.b is not a valid host name"):
        one.open()
    one.close()


def test_a_missing_password_variable_is_reported_before_connecting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_SUCH", raising=False)
    with caster(saying(V2)) as found:
        with pytest.raises(TransportError, match="this environment variable is not set"):
            transport(found, "?user=a&password_env=NO_SUCH").open()
        assert found.requests == []


def test_a_silent_caster_does_not_block_the_caller() -> None:
    hold = threading.Event()
    stopped = threading.Event()
    with caster(saying(hold=hold)) as found:
        spec = parse_transport(f"ntrip:127.0.0.1:{found.port}/A")
        threading.Timer(0.3, stopped.set).start()
        started_s = time.monotonic()
        with pytest.raises(TransportError, match="not connected in time"):
            NtripTransport(spec, stopped.is_set).open()
        assert time.monotonic() - started_s < 6.0  # it would otherwise wait for 8 s
        hold.set()


def test_opening_ends_by_its_deadline_however_slow_the_network_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Name servers do not answer; opening gives up before the recorder's watchdog would call it stuck."""
    monkeypatch.setattr(tcp_socket, "OPEN_S", 0.3)
    hold = threading.Event()
    made: list[socket.socket] = []

    def slow(address: tuple[str, int], timeout: float) -> socket.socket:
        hold.wait(30.0)
        made.append(socket.socket())
        return made[-1]

    monkeypatch.setattr(socket, "create_connection", slow)
    one = NtripTransport(TransportSpec("ntrip", "caster.example:2101/ZIMM0"))
    with pytest.raises(TransportError, match=r"caster\.example:2101/ZIMM0: no connection within 0\.3 s"):
        one.open()
    one.close()
    hold.set()


def test_a_bad_chunk_raises_a_transport_error() -> None:
    with caster(saying(CHUNKED + b"5\r\nabcde\r\nzz\r\n")) as found:
        one = transport(found)
        one.open()
        with pytest.raises(TransportError, match="a chunk's length is zz"):
            received(one, 6)
        one.close()


def test_a_position_is_sent_to_the_caster() -> None:
    def script(sock: socket.socket, number: int) -> None:
        sock.sendall(V2)
        listen(found, sock, 5.0)

    with caster(script) as found:
        one = transport(found, "?position=47.5,-8.75,512.5")
        one.open()
        one.receive(0.1)
        deadline_s = time.monotonic() + 10.0
        while not found.said.endswith(b"\r\n") and time.monotonic() < deadline_s:
            one.receive(0.1)
        one.close()
    message = pynmea2.parse(found.said.decode().strip(), check=True)
    assert (message.latitude, message.longitude, message.altitude, message.gps_qual) == (47.5, -8.75, 512.5, 1)


@pytest.mark.parametrize("lat", [0.0, -0.99999999, 59.999999999, 89.9999999, -33.123456])
def test_gga_sentence_matches_pynmea2(lat: float) -> None:
    now = dt.datetime(2026, 11, 21, 10, 15, 3, tzinfo=dt.UTC)
    message = pynmea2.parse(gga_sentence(lat, -179.999999999, 8848.0, now).decode().strip(), check=True)
    assert message.latitude == pytest.approx(lat, abs=0.00005 / 60 + 1e-9)
    assert message.longitude == pytest.approx(-180.0, abs=0.00005 / 60 + 1e-9)
    assert message.timestamp.strftime("%H:%M:%S") == "10:15:03"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ntrip:caster:2101", "want ntrip:<host>:<port>/<mountpoint>"),
        ("ntrip:caster/A", "want ntrip:<host>:<port>/<mountpoint>"),
        ("ntrip:caster:99999/A", "port '99999' should be 1 to 65535"),
        ("ntrip:a..b:2101/A", "host 'a..b' is not a valid host name"),
        (f"ntrip:{'a' * 64}.example:2101/A", "want 1 to 63 letters between its dots"),
        ("ntrip:caster:2101/A B", "want ntrip:<host>:<port>/<mountpoint>"),
        ("ntrip:caster:2101/A?password=x", "unknown option 'password'; ntrip knows: user, password_env"),
        ("ntrip:caster:2101/A?password_env=X", "password_env needs user=<name> too"),
        ("ntrip:caster:2101/A?user=a&password_env=a-b", "should be the name of the environment variable"),
        ("ntrip:caster:2101/A?position=47.5,8.7", "should be latitude,longitude,height"),
        ("ntrip:caster:2101/A?position=97.5,8.7,1", "should be latitude,longitude,height"),
        ("ntrip:caster:2101/A?version=3", "should be 1 or 2"),
    ],
)
def test_wrong_ntrip_texts_are_refused(text: str, said: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse_transport(text)
    assert said in str(caught.value)


def test_an_ipv6_address_is_accepted() -> None:
    spec = parse_transport("ntrip:[::1]:2101/A/B")
    assert (spec.ntrip_host, spec.ntrip_port, spec.mountpoint) == ("::1", 2101, "A/B")
