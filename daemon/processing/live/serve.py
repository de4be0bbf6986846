"""Serves what ``live.mcap`` gets to Foxglove's viewer while it comes: its WebSocket protocol, on this computer only.

The SDK's server runs in threads of its own and keeps a short queue for each client. When a client is slow its oldest
messages are dropped, so that neither a slow client nor a dead one holds live up.
"""

from __future__ import annotations

from typing import Any

import foxglove

from swath.daemon.errors import ExitCode, UserError, one_line

ADDRESS, PORT = "127.0.0.1", 8765  # the port that Foxglove's viewer proposes
QUEUED = 64  # messages for a client: some seconds; of points, 100 MB at most
SUBPROTOCOL = "foxglove.sdk.v1"


class LiveServer:
    """Foxglove's WebSocket server on this computer.

    Attributes:
        port: port that it listens at.
    """

    def __init__(self, port: int = PORT) -> None:
        """Listen; port 0 is any free one.

        Raises:
            UserError: the port is in use.
        """
        self._context = foxglove.Context()
        self._channels: dict[str, Any] = {}
        try:
            self._server = foxglove.start_server(
                name="swath live", host=ADDRESS, port=port, context=self._context, message_backlog_size=QUEUED
            )
        except (OSError, RuntimeError) as error:
            text = f"{ADDRESS}:{port}: {error}; another swath live may serve there: --serve-port PORT"
            raise UserError(one_line(text), ExitCode.IO) from error
        self.port: int = self._server.port

    def send(self, topic: str, schema: Any, data: bytes, log_time_ns: int) -> None:
        """Give a message, encoded as its schema says, to all clients that have subscribed to its topic."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = foxglove.Channel(topic, schema=schema, message_encoding="protobuf", context=self._context)
            self._channels[topic] = channel
        channel.log(data, log_time=log_time_ns)

    def close(self) -> None:
        """End the server and its clients' connections."""
        self._server.stop()
