"""Tests what Foxglove's viewer is served, by a client that speaks its protocol with a WebSocket library alone.

The protocol is ``foxglove.sdk.v1`` (github.com/foxglove/ws-protocol, docs/spec.md): JSON texts from the server
announce channels with their schemas, the client subscribes to some, and each message comes as a binary frame: an opcode
of 1, the subscription's number (u4), the log time (u8), the data.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from swath.daemon.config.tables import LiveConfig
from swath.daemon.errors import UserError
from swath.daemon.processing.live.mcap import NAME
from swath.daemon.processing.live.products import LiveProducts
from swath.daemon.processing.live.serve import LiveServer
from swath.georef.timescales.gps_time import SECOND_NS
from tests.daemon.processing.live.builders import Schema, Utm, flight, points_at, read_back

pytestmark = pytest.mark.xdist_group("kernels")

TOPICS = {
    "/points/left": "foxglove.PointCloud",
    "/position": "foxglove.LocationFix",
    "/pose": "foxglove.PoseInFrame",
    "/tf": "foxglove.FrameTransform",
    "/coverage": "foxglove.Grid",
    "/status": "foxglove.Log",
}
WAIT_S = 20.0


def connected(server: LiveServer) -> ClientConnection:
    """Return a client that the server has accepted."""
    url = f"ws://127.0.0.1:{server.port}"
    return connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None, open_timeout=WAIT_S)


def subscribed(client: ClientConnection, wanted: set[str]) -> dict[int, dict[str, Any]]:
    """Return the channels of topics by the subscription's number; they are subscribed to once they are announced."""
    found: dict[int, dict[str, Any]] = {}
    while {channel["topic"] for channel in found.values()} != wanted:
        told = client.recv(WAIT_S)
        assert isinstance(told, str)
        for channel in json.loads(told).get("channels", []):
            if channel["topic"] in wanted:
                found[100 + channel["id"]] = channel
    ids = [{"id": number, "channelId": channel["id"]} for number, channel in found.items()]
    client.send(json.dumps({"op": "subscribe", "subscriptions": ids}))
    return found


def received(client: ClientConnection, channels: dict[int, dict[str, Any]]) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, log time and content of the messages that have come, decoded by the schemas announced."""
    while True:
        try:
            frame = client.recv(0.3)
        except TimeoutError:
            return
        if isinstance(frame, bytes):
            kind, number, time_ns = struct.unpack_from("<BIQ", frame)
            assert kind == 1
            channel = channels[number]
            schema = Schema(base64.b64decode(channel["schema"]))
            yield channel["topic"], time_ns, schema.decode(f".{channel['schemaName']}", frame[13:])


def fly(products: LiveProducts, second: int) -> None:
    """Give the products a second of flight: points, a pose, a sentence."""
    trajectory = flight()
    at_ns = (100 + 20 * second) * SECOND_NS
    products.take("left", points_at(Utm().map_from_e(trajectory.position_e)), trajectory, at_ns)
    products.take_pose(trajectory, at_ns)
    products.publish_status(f"second {second}", well=second % 2 == 0, log_time_ns=at_ns)


def test_a_client_gets_what_the_file_gets(tmp_path: Path) -> None:
    server = LiveServer(0)
    products = LiveProducts(tmp_path, LiveConfig(cell_m=5.0), Utm(), 0, "EPSG:32632", server=server)
    fly(products, 0)
    with connected(server) as client:
        assert client.subprotocol == "foxglove.sdk.v1"
        channels = subscribed(client, set(TOPICS))
        assert {one["topic"]: one["schemaName"] for one in channels.values()} == TOPICS
        got: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
        second = 0
        while any(len(messages) < 2 for messages in got.values()):  # the first ones may come before the subscription
            second += 1
            fly(products, second)
            for topic, time_ns, message in received(client, channels):
                got[topic].append((time_ns, message))
    products.close()
    server.close()
    written = read_back(tmp_path / NAME)
    for topic, messages in got.items():
        last = written[topic][-len(messages) :]
        assert messages == [(one.pop("log_time"), one) for one in last if one.pop("schema")], topic
    cells = np.frombuffer(got["/coverage"][-1][1]["data"], "<f4")
    assert cells.sum() * 25.0 == pytest.approx(11 * (second + 1))  # all points, on cells of 25 m²
    assert got["/status"][-1][1]["message"] == f"second {second}"


@pytest.mark.slow
def test_a_client_that_never_reads_holds_nothing_up(tmp_path: Path) -> None:
    """Without dropping, 400 MB would wait for it."""
    server = LiveServer(0)
    products = LiveProducts(tmp_path, LiveConfig(), Utm(), 0, "EPSG:32632", server=server)
    fly(products, 0)
    with connected(server) as client:
        subscribed(client, {"/points/left"})
        before = psutil.Process().memory_info().rss
        for _ in range(400):
            server.send("/points/left", None, bytes(1_000_000), SECOND_NS)
        assert psutil.Process().memory_info().rss - before < 100e6
    products.close()
    server.close()


def test_a_port_in_use_is_named() -> None:
    server = LiveServer(0)
    with pytest.raises(UserError, match=rf"127\.0\.0\.1:{server.port}: .*--serve-port PORT"):
        LiveServer(server.port)
    server.close()
