"""Tests the wall clock in flight: stepped by an hour, slewed, and with a leap second inserted by the kernel."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

from swath.georef.timescales.gps_time import SECOND_NS
from tests.daemon.log_check import read_log
from tests.vm.crew import aboard, facts
from tests.vm.machine import MODULES
from tests.vm.seconds import labelled, wrong_seconds


def test_a_clock_stepped_slewed_and_with_a_leap_second_gives_no_wrong_second(tmp_path: Path) -> None:
    aboard(tmp_path, "aboard_time", "wall_clock", MODULES / "pps_sim.ko", seconds=75)
    told = facts(tmp_path, "told")
    assert told["inserted"], "the kernel inserted no leap second"
    content = read_log(tmp_path / "logs")
    clocks = [value for _, value in content.messages["/clock"]]
    offset_ns = clocks[0]["realtime_ns"] - clocks[0]["monotonic_ns"]

    # all steps were seen: four of an hour, one to before midnight, the leap second
    offsets = [clock["realtime_ns"] - clock["monotonic_ns"] for clock in clocks]
    jumps = [round((later - earlier) / SECOND_NS) for earlier, later in pairwise(offsets)]
    assert [jump for jump in jumps if jump][:4] == [3600, -3600, -3600, 3600]
    assert [jump for jump in jumps if jump][5:] == [-1]
    assert len(content.events("wall_clock_stepped")) >= 6

    # by a receiver and pulses that are never stepped, no second is wrong
    moments = labelled(tmp_path / "logs")
    assert wrong_seconds(moments, lambda moment: moment.raw_ns + told["base_ns"]) == []
    assert sum(moment.state == "LOCKED" for moment in moments) > 200

    # there is no gap: each second has a pulse, and all are accounted for; log_time has no steps, the least of which
    # would be a second, but an emulated timer sometimes makes a pulse some hundredths late
    edges = [value["edge_time_ns"] - offset_ns for _, value in content.messages["/pps/main"]]
    sequences = [value["sequence"] for _, value in content.messages["/pps/main"]]
    for (edge, sequence), (later, next_sequence) in pairwise(zip(edges, sequences, strict=True)):
        assert next_sequence > sequence
        assert abs(later - edge - (next_sequence - sequence) * SECOND_NS) < 0.2 * SECOND_NS
    missed = sequences[-1] - sequences[0] + 1 - len(sequences)
    assert content.messages["/status/pps/main"][-1][1]["lost_kernel"] == missed == 0
    for source in ("pps/main", "gnss/rover"):
        status = content.messages[f"/status/{source}"][-1][1]
        assert status["lost_queue"] == status["lost_write"] == 0
