"""Tests datagrams written as pcap frames with dpkt and with our own reader."""

from __future__ import annotations

import io
import socket
from pathlib import Path

import dpkt
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swath.drivers.captures.base import Address
from swath.drivers.captures.opening import read_pcap
from swath.drivers.captures.pcap.writer import FILE_HEADER, LATEST_PCAP_NS, largest_payload, pcap_frames

SCANNER: Address = ("192.168.1.201", 2368)
HEAD: Address = ("fe80::1", 2368)
COMPUTER: Address = ("239.1.2.3", 7000)
TIME_NS = 1_700_000_000_123_456_789


def frames(source: Address, destination: Address, payloads: list[bytes]) -> bytes:
    """Return a complete file of payloads of one length, a nanosecond apart."""
    rows = np.array([list(payload) for payload in payloads], np.uint8).reshape(len(payloads), -1)
    times = TIME_NS + np.arange(len(payloads), dtype=np.int64)
    return FILE_HEADER + pcap_frames(times, 65_530, source, destination, rows).tobytes()


@given(st.lists(st.binary(min_size=7, max_size=7), min_size=1, max_size=20))
def test_dpkt_reads_our_ipv4_frames_with_valid_checksums(payloads: list[bytes]) -> None:
    reader = dpkt.pcap.Reader(io.BytesIO(frames(SCANNER, COMPUTER, payloads)))
    assert reader.datalink() == dpkt.pcap.DLT_EN10MB
    identifications = []
    for frame, payload in zip([bytes(frame) for _, frame in reader], payloads, strict=True):
        ip = dpkt.ethernet.Ethernet(frame).data
        assert (socket.inet_ntoa(ip.src), socket.inet_ntoa(ip.dst)) == (SCANNER[0], COMPUTER[0])
        assert (ip.data.sport, ip.data.dport, bytes(ip.data.data)) == (2368, 7000, payload)
        assert ip.len == 28 + len(payload)
        assert dpkt.in_cksum(bytes(ip)[:20]) == 0  # a header with its checksum sums to none
        identifications.append(ip.id)
    assert 0 not in identifications
    assert len(set(identifications)) == len(identifications)


@given(st.binary(max_size=64))
def test_ipv6_checksum_matches_dpkt(payload: bytes) -> None:
    [(_, frame)] = dpkt.pcap.Reader(io.BytesIO(frames(HEAD, ("fe80::2", 7000), [payload])))
    ip6 = dpkt.ethernet.Ethernet(frame).data
    ours = ip6.data.sum
    ip6.data.sum = 0
    pseudo = ip6.src + ip6.dst + (8 + len(payload)).to_bytes(4, "big") + b"\0\0\0\x11"
    assert ours == (dpkt.in_cksum(pseudo + bytes(ip6.data)) or 0xFFFF)
    assert bytes(ip6.data.data) == payload


@pytest.mark.parametrize(
    ("source", "destination"), [(SCANNER, COMPUTER), (HEAD, ("fe80::2", 7000)), (HEAD, ("239.1.2.3", 7000))]
)
def test_our_reader_returns_written_datagrams_up_to_the_largest_size(
    tmp_path: Path, source: Address, destination: Address
) -> None:
    payloads = [bytes([n]) * largest_payload(source, destination) for n in range(3)]
    path = tmp_path / "big.pcap"
    path.write_bytes(frames(source, destination, payloads))
    units = list(read_pcap(path, drop_copies=True))
    assert [(unit.time_ns, unit.data, unit.source) for unit in units] == [
        (TIME_NS + n, payload, source) for n, payload in enumerate(payloads)
    ]


def test_timestamps_reach_from_1970_to_2106(tmp_path: Path) -> None:
    times = np.array([0, 1, LATEST_PCAP_NS], np.int64)
    path = tmp_path / "ends.pcap"
    path.write_bytes(FILE_HEADER + pcap_frames(times, 0, SCANNER, COMPUTER, np.zeros((3, 0), np.uint8)).tobytes())
    assert [unit.time_ns for unit in read_pcap(path)] == times.tolist()
