"""A flight of seconds over flat land with event marks, into a log: for tests of what navigation reads and makes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from daemon.config import Config, load_config
from daemon.log.reader import Session, open_logs
from daemon.sim_log import fly_into_log
from drivers.gnss import novatel_layouts as nov
from drivers.gnss.novatel_encoder import encode_log
from drivers.gnss.novatel_tables import CLOCK_VALID
from georef.trajectory import Trajectory
from sim.companions import companion_files, config_text, default_wires
from sim.fly import VirtualFlight, open_truth
from sim.gnss.novatel import NovatelMessages
from sim.plan import parse_plan

MARK_AFTER_NS = 123_456_789  # of each whole second
CLOCK_OFFSET_S = 2.5e-7  # of the receiver, in what its marks say
CLOCK_SIGMA_S = 1e-4


@dataclass(frozen=True)
class Flown:
    """The log, its configuration and the truth."""

    folder: Path
    config: Config

    @property
    def log(self) -> Path:
        """Its one part."""
        return next(self.folder.glob("logs/*.mcap"))

    def session(self) -> Session:
        """Opened anew."""
        (session,) = open_logs([self.folder / "logs"])
        return session

    def truth(self) -> Trajectory:
        """Of the body, 200 Hz."""
        told: Any = np.load(self.folder / "truth.npz")
        keys = ("gps_ns", "lat_rad", "lon_rad", "height_m", "velocity_l", "roll_rad", "pitch_rad", "heading_rad")
        return Trajectory.from_geodetic(*(told[f"trajectory.{key}"] for key in keys), name="truth")

    def changed(self, name: str, **changes: str) -> Config:
        """Its configuration with words replaced, under another name."""
        text = (self.folder / "swath.toml").read_text()
        for old, new in changes.items():
            assert old in text, old
            text = text.replace(old, new)
        path = self.folder / name
        path.write_text(text)
        return load_config(path)


@contextmanager
def marking() -> Iterator[None]:
    """While this lasts virtual NovAtel receivers stamp an event some time after each whole second."""
    plain = NovatelMessages.epoch

    def epoch(self: NovatelMessages, epochs: Any, row: int) -> list[bytes]:
        messages = plain(self, epochs, row)
        stamp = self._calendar.at(float(epochs.time_s[row]))
        if stamp.second is not None:
            second = stamp.tow_ms // 1000 - 1 + MARK_AFTER_NS * 1e-9 + CLOCK_OFFSET_S
            mark = nov.MarkTime(stamp.week, second, CLOCK_OFFSET_S, CLOCK_SIGMA_S, -18.0, CLOCK_VALID)
            messages.append(encode_log("MARK2TIME", mark, stamp.week, stamp.tow_ms))
        return messages

    with patch.object(NovatelMessages, "epoch", epoch):
        yield


def fly_short(folder: Path, plan_text: str, seconds: float = math.inf) -> Flown:
    """Fly a plan into a log; all of it, or its first seconds."""
    plan = parse_plan(plan_text, Path())
    truth = open_truth(plan, folder / "truth.npz")
    flight = VirtualFlight(plan, truth, seconds)
    for name, data in companion_files(plan, flight.site, flight.scene).items():
        (folder / name).write_bytes(data)
    (folder / "swath.toml").write_text(config_text(plan, default_wires(plan), "logs"))
    config = load_config(folder / "swath.toml")
    with marking():
        fly_into_log(config, folder / "logs", flight, plan.tables.flight.seed)
    flight.finish_truth()
    return Flown(folder, config)
