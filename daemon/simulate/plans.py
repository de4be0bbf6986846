"""Loads the virtual aircraft from `sim` for the commands that need it; no other module of `daemon` imports `sim`."""

from __future__ import annotations

import contextlib
import importlib.util
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.drivers.extras import how_to_install

if TYPE_CHECKING:
    from swath.daemon.simulate.flight import Flight

NEEDS = ("scipy", "pyproj", "numba", "matplotlib")
WARM_UP_S = 0.3  # long enough for a block of every source


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """The options of the command line that choose a plan.

    Attributes:
        plan: a file, or a preset's name.
        seed: replaces the plan's own.
        seconds: fly only the first seconds.
    """

    plan: str
    seed: int | None = None
    seconds: float | None = None

    def load(self) -> Any:
        """Load the plan.

        Raises:
            UserError: it does not exist, a key is wrong, or a package that `sim` needs is not installed.
        """
        _check_installed()
        from swath.sim.plan.plan import load_plan

        with self.as_user_errors():
            plan = load_plan(self.plan)
            return plan if self.seed is None else plan.with_seed(self.seed)

    @contextlib.contextmanager
    def as_user_errors(self, *names: str) -> Iterator[None]:
        """Turn an error of the plan within the block into a `UserError`.

        Args:
            names: of other files that the error may concern.
        """
        from swath.sim.plan.errors import PlanError

        try:
            yield
        except PlanError as error:
            text = str(error) if error.key in (self.plan, *names) else f"{self.plan}: {error}"
            raise UserError(one_line(text), ExitCode.USAGE) from error


def _check_installed() -> None:
    missing = [name for name in NEEDS if importlib.util.find_spec(name) is None]
    if missing:
        text = f"swath sim needs {', '.join(missing)}, which are not installed: {how_to_install('sim')}"
        raise UserError(text, ExitCode.USAGE)


def make_flight(options: FlightOptions, truth: Path | None = None) -> tuple[Flight, dict[str, bytes]]:
    """Make a flight, and the files that accompany it except the configuration.

    Args:
        options: the plan to fly.
        truth: file for the truth; None writes no truth.

    Raises:
        UserError: it cannot be flown.
        OSError: the truth cannot be written.
    """
    plan = options.load()
    from swath.sim.companions import companion_files
    from swath.sim.fly import VirtualFlight, open_truth

    writer = None if truth is None else open_truth(plan, truth)
    try:
        with options.as_user_errors():
            flight = VirtualFlight(plan, writer, math.inf if options.seconds is None else options.seconds)
            return flight, companion_files(plan, flight.site, flight.scene)
    except BaseException:
        if writer is not None:
            writer.abandon()
        raise


def make_flight_in_time(options: FlightOptions) -> tuple[Flight, dict[str, bytes]]:
    """Make a flight as `make_flight` does, but for real time: all functions that are compiled on first use are compiled
    before.

    For this, a moment of the same flight is flown with all scanners on.
    """
    plan = options.load()
    from swath.sim.fly import VirtualFlight

    always_on = {name: {"on_lines_only": False} for name in plan.tables.scanner}
    with options.as_user_errors():
        for _ in VirtualFlight(plan.changed({"scanner": always_on}), None, WARM_UP_S).units():
            pass
    return make_flight(options)


def configuration(plan: Any, wires: dict[str, str] | None, directory: str) -> bytes:
    """Return the configuration that records a flight.

    Args:
        plan: of `FlightOptions.load`.
        wires: transports and PPS sources by source; None uses those of an aircraft's computer.
        directory: for logs.
    """
    from swath.sim.companions import config_text, default_wires

    text: str = config_text(plan, default_wires(plan) if wires is None else wires, directory)
    return text.encode()


def draw(options: FlightOptions, picture: Path) -> list[dict[str, Any]]:
    """Draw a plan and return its coverage: one row for each line and one for all. Raises UserError, OSError."""
    plan = options.load()
    from swath.sim.preview.picture import draw_plan

    with options.as_user_errors(str(picture)):
        rows: list[dict[str, Any]] = draw_plan(plan, picture)
        return rows
