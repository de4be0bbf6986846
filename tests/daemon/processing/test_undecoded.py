"""Tests what is said of messages that gave no returns."""

from __future__ import annotations

import datetime as dt

import numpy as np

from swath.daemon.processing.undecoded import refused_by, undecoded_lines
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.robosense.heads import HELIOS32, RS16
from swath.drivers.scanner.robosense.parser import RobosenseParser, encode_difop, encode_msop
from tests.drivers.builders import feed


def test_packets_of_another_model_are_named() -> None:
    """The model in the configuration is not the one that sends (RoboSense-LiDAR/rslidar_sdk #13)."""
    difop = encode_difop(RS16, np.arange(-15.0, 16.0, 2.0))
    parser = RobosenseParser(DeviceSettings("scanner/left", {}, {"geometry": difop}), RS16)
    time = dt.datetime(2026, 11, 21, tzinfo=dt.UTC)
    feed(parser, [encode_msop(time, np.arange(12) * 20, np.full((12, 32), 1000), 7, HELIOS32)] * 3)
    holes, (warning,) = undecoded_lines("a.mcap", {"left": refused_by(parser)})
    assert holes == []
    assert warning.startswith("a.mcap: 3 messages of scanner/left were not read: they are of another model")
