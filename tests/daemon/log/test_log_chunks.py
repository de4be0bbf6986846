"""Tests that a chunk's messages are read as whole runs of equal channel and length."""

from __future__ import annotations

import random
from itertools import groupby

import numpy as np
import pytest

from swath.daemon.log.format import ChannelSpec
from swath.daemon.log.mcap.chunks import ONE_BY_ONE, chunk_batches
from swath.daemon.log.mcap.encode import encode_block

CHANNELS = {
    number: ChannelSpec(f"/scanner/{name}/raw", "x-swath-udp", {"protocol": "srep"}, None, "scanner")
    for number, name in ((1, "left"), (2, "right"), (257, "top"))
}
COUNTS = [1, 1, 2, 3, 14, ONE_BY_ONE - 1, ONE_BY_ONE, ONE_BY_ONE + 1, 3 * ONE_BY_ONE]


@pytest.mark.parametrize("seed", range(20))
def test_runs_are_complete_and_contiguous(seed: int) -> None:
    chance = random.Random(seed)
    written: list[tuple[int, int, bytes]] = []  # channel, time, data
    data = b""
    for _ in range(chance.randint(1, 30)):
        channel, length, count = chance.choice([1, 2, 257]), chance.choice([0, 9, 52, 308]), chance.choice(COUNTS)
        times = len(written) + np.arange(count, dtype=np.int64)
        units = np.frombuffer(chance.randbytes(count * length), np.uint8).reshape(count, length)
        data += bytes(encode_block(channel, len(written), times, units).data)
        written += [(channel, int(time_ns), unit.tobytes()) for time_ns, unit in zip(times, units, strict=True)]
    found = [
        [(batch.channel_id, int(time_ns), unit.tobytes()) for time_ns, unit in zip(*columns, strict=True)]
        for batch in chunk_batches(data, dict(CHANNELS), {})
        for columns in [(batch.log_time_ns, batch.units)]
    ]
    assert found == [list(run) for _, run in groupby(written, key=lambda one: (one[0], len(one[2])))]
