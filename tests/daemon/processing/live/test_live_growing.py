"""Tests ``swath live`` beside a recorder, in real time: a virtual aircraft on wires, three processes, one log."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from swath.daemon.config.tables import LiveConfig
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.live.session import Told, replay
from swath.daemon.processing.setup.setup import Options, Setup
from swath.daemon.processing.warm_up import warm_up
from tests.builders import running
from tests.daemon.processing.live.builders import PLAN, config_of
from tests.daemon.rig import HANGS_S, Recorder, wait_until

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.xdist_group("kernels")]

SECONDS = 6.5


def test_points_made_during_recording_equal_those_of_the_replay(tmp_path: Path) -> None:
    """The bytes are equal across part changes; nothing is skipped, and the delay is reported."""
    warm_up([])  # otherwise the command compiles first and reports that
    logs, points, said, plan = (tmp_path / name for name in ("logs", "points.npy", "said", "plan.toml"))
    logs.mkdir()
    plan.write_text(PLAN.replace("rate_hz = 1\n", "rate_hz = 20\n"))
    wires = tmp_path / "wires"
    fly = ("sim", "fly", plan, "--wire", "-o", wires, "--seconds", f"{SECONDS:g}", "--wait", f"{HANGS_S:g}")
    with (
        said.open("w") as output,
        running(*fly) as flying,
        running("live", logs, "--points", points, "--json", output=output) as live,
    ):
        config = config_of(wires, tmp_path)
        wait_until(lambda: "waiting for a recording" in said.read_text(), "live waits")
        with Recorder(tmp_path, config) as recorder:
            flying.communicate(timeout=HANGS_S)
            time.sleep(1.0)  # what is still on its way through the recorder
            assert recorder.stop() == 0
        _, trouble = live.communicate(timeout=HANGS_S)
    told: list[Told] = [json.loads(line) for line in said.read_text().splitlines()]
    assert (flying.returncode, live.returncode, trouble) == (0, 0, "")
    assert told[-1]["state"] == "ended (the recording has ended)"
    assert (told[-1]["live_skipped_s"], told[-1]["damaged_chunks"], told[-1]["trouble"]) == (0.0, 0, "")

    (session,) = open_logs([logs])
    assert len(session.parts) >= 3
    assert {one["part"] for one in told if "part" in one} >= {0, 1, 2}
    setup = Setup.of_log(session.attachments(), Options(uncertainty=False))
    replayed = replay(session, setup, tmp_path / "replayed", LiveConfig(), tmp_path / "replayed.npy")
    assert points.read_bytes() == (tmp_path / "replayed.npy").read_bytes()
    assert len(np.load(points)) == sum(replayed["points"].values()) > 10_000
    for key in ("points", "fates"):
        assert told[-1][key] == replayed[key]

    while_flying = [one for one in told if one.get("latency_s", {}).get("scanner/left", {}).get("pulse")]
    assert len(while_flying) > 2
    for one in while_flying:
        pulse = one["latency_s"]["scanner/left"]["pulse"]
        assert 0.1 < pulse["p50"] <= pulse["p95"] <= pulse["max"], "a chunk is open for a while"
        assert one["behind_s"] >= 0.0
        assert " s behind the pulse" in one["sentence"]
