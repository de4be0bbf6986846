"""Tests a recorder that stalls for half a second: installed settings lose nothing, the default is counted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests.daemon.log_check import LogContent, read_log
from tests.vm.aboard_stall import STALL_S
from tests.vm.crew import aboard, facts


def numbers(content: LogContent) -> list[int]:
    return [int.from_bytes(data[:8], "little") for _, data in content.units["scanner/left"]]


def test_a_stall_of_half_a_second_loses_no_data_or_is_counted_with_a_small_buffer(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    aboard(tmp_path, "aboard_stall", "stall", seconds=60)
    told = facts(tmp_path, "told")
    record_property("datagrams_per_s", told["rate_hz"])
    installed, default = told["installed"], told["default"]
    assert installed["stood_s"] > 0.9 * STALL_S
    assert told["in_stall"] == round(told["rate_hz"] * STALL_S)

    content = read_log(tmp_path / "installed")
    status = content.messages["/status/scanner/left"][-1][1]
    assert status["receive_buffer_bytes"] > 30_000_000, status
    assert installed["drops"] == installed["before"], "lost in the stall"
    assert status["lost_kernel"] == installed["drops"]
    assert status["units"] == installed["sent"]
    got = numbers(content)
    first = installed["sent"] - 2 * told["in_stall"]  # the units of the stall, and as many after it
    assert got[got.index(first) :] == list(range(first, installed["sent"]))

    content = read_log(tmp_path / "default")
    status = content.messages["/status/scanner/left"][-1][1]
    assert status["receive_buffer_bytes"] <= 212_992, status
    assert status["lost_kernel"] == default["drops"] > 0
    assert status["written"] + status["lost_kernel"] == default["sent"] == status["units"]
    assert len(numbers(content)) == status["written"]
    assert status["lost_queue"] == status["lost_write"] == 0
