"""The second part: the virtual aircraft, a whole flight of it in real time."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from rich.console import Console

from demo.proof import Show
from swath.daemon.simulate.ahead import Ahead
from swath.daemon.simulate.on_wires import own_wires
from swath.daemon.simulate.plans import FlightOptions, configuration, make_flight_in_time

PLAN = "small"
WHAT = {
    "gnss/rover": "NovAtel receiver, RTK, two antennas, its own INS, through a pty",
    "imu/main": "tactical IMU, 200 Hz, latches PPS, through a CAN bus (udp_multicast)",
    "scanner/left": "oscillating mirror, 70 000 pulses a second, SREP/1 through UDP",
    "pps/main": "the receiver's pulse, wired to computer, IMU and scanner",
}
REMARK = (
    "All streams belong to one simulated flight; `swath sim fly small -o LOG` writes it into a log, with the truth "
    "of every return."
)


def take_off(seconds: float) -> Ahead:
    """Begin to make the flight, in a process of its own."""
    return Ahead(partial(make_flight_in_time, FlightOptions(PLAN, seconds=seconds)))


def prepare(console: Console, folder: Path, ahead: Ahead) -> Show:
    """Write the configuration and the files that it names."""
    with console.status("preparing the simulated flight (compiled at the first run)"):
        facts = ahead.facts
    plan = FlightOptions(PLAN).load()
    folder.mkdir(parents=True, exist_ok=True)
    wires = own_wires(folder, facts.sources, {f"gnss/{name}": table.baud for name, table in plan.tables.gnss.items()})
    for name, data in (facts.files | {"swath.toml": configuration(plan, wires, "logs")}).items():
        (folder / name).write_bytes(data)
    return Show("a simulated flight, in real time", WHAT, ahead.units(), facts.duration_s, REMARK)
