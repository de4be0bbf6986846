"""What cannot go together is refused in one line that names both files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from daemon.config.config import Config
from daemon.config.loading import parse_config
from daemon.errors import UserError
from daemon.processing import refusals
from georef.timescales import ClockStatus, TimeState

A, B = Path("a.mcap"), Path("b.mcap")
TEXT = """
[session]
name = "x"
directory = "."
[gnss.rover]
transport = "serial:/dev/null?baud=9600"
protocol = "novatel"
lever_arm_m = {arm}
[output]
crs = "{crs}"
epoch = {epoch}
"""


def config(arm: str = "[0.1, 0.0, -1.2]", crs: str = "EPSG:25832", epoch: float = 2026.5) -> Config:
    return parse_config(TEXT.format(arm=arm, crs=crs, epoch=epoch), Path("swath.toml"))


def line(refused: Any) -> str:
    """One, with both files."""
    text = str(refused.value)
    assert "\n" not in text
    return text


def test_logs_with_different_frames() -> None:
    configs = {A: config(), B: config(crs="EPSG:2056")}
    with pytest.raises(UserError) as refused:
        refusals.refuse_different_settings(configs, None)
    assert all(word in line(refused) for word in ("a.mcap", "b.mcap", "EPSG:2056", "EPSG:25832", "--crs"))
    refusals.refuse_different_settings(configs, "EPSG:25832")
    with pytest.raises(UserError, match=r"output\.epoch is 2020\.0"):
        refusals.refuse_different_settings({A: config(), B: config(epoch=2020.0)}, None)
    refusals.refuse_different_settings({A: config(), B: config()}, None)


def test_sessions_with_different_antennas() -> None:
    with pytest.raises(UserError) as refused:
        refusals.refuse_different_settings({A: config(), B: config(arm="[0.1, 0.0, -1.3]")}, None)
    assert all(word in line(refused) for word in ("gnss.rover.lever_arm_m", "-1.3", "-1.2", "another antenna"))


def test_logs_of_one_time() -> None:
    refusals.refuse_overlap({B: (200, 300), A: (0, 200)})
    with pytest.raises(UserError) as refused:
        refusals.refuse_overlap({B: (199, 300), A: (0, 200)})
    assert all(word in line(refused) for word in ("a.mcap", "b.mcap", "two recordings"))


def test_a_second_that_is_not_certain_and_no_time() -> None:
    good = ClockStatus(TimeState.LOCKED, 100.0)
    refusals.refuse_no_time(A, "pps/main", good)
    with pytest.raises(UserError, match="not certain: messages contradict"):
        refusals.refuse_no_time(A, "pps/main", ClockStatus(TimeState.COARSE, 1e8, ambiguous="messages contradict"))
    with pytest.raises(UserError, match="nothing in the log says the time"):
        refusals.refuse_no_time(A, "pps/main", ClockStatus(TimeState.NO_TIME, float("inf")))
    with pytest.raises(UserError, match="no source of time"):
        refusals.refuse_no_time(A, None, None)


@pytest.mark.parametrize(
    ("refused", "state", "words"),
    [
        ({"past_hour": 5}, TimeState.LOCKED, "locked to another second"),
        ({"spacing": 3}, TimeState.LOCKED, "3 edges that it latched"),
        ({}, TimeState.LOCKED, "run free"),
        ({}, TimeState.COARSE, "the host's clock is coarse"),
    ],
)
def test_why_returns_have_no_time(refused: dict[str, int], state: TimeState, words: str) -> None:
    fates = {"no_time": 500, "georeferenced": 500}
    (told,) = refusals.time_troubles(A, "left", fates, refused, ClockStatus(state, 1.0))
    assert words in told
    assert "500 of 1,000 returns" in told
    assert refusals.time_troubles(A, "left", {"no_time": 10, "georeferenced": 990}, refused, None) == []
    refusals.refuse_all_lost([told], 500)
    with pytest.raises(UserError, match="have no time"):
        refusals.refuse_all_lost([told], 0)
