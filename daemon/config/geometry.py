"""Says where the devices are mounted: in words, and as a small drawing of text from the side and from above.

The body's axes are forward, right, down, with the IMU at the origin (conventions).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swath.daemon.config.config import Config
from swath.daemon.config.findings import scanner_lever_arm_b
from swath.georef.arrays import FloatArray

AXES = (("forward", "backward"), ("right", "left"), ("below", "above"))
TURNS = (("forward", "backward"), ("right", "left"), ("down", "up"))
STRAIGHT_DEG = 0.5  # an axis this near to one of the body is not said to be turned
COLUMNS, ROWS = 40, 12  # of a drawing, at most
STEPS_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
SEVERAL = "*"


@dataclass(frozen=True, slots=True)
class Placed:
    """A device with a place in the body.

    Attributes:
        name: its name for people, such as "antenna of gnss/rover".
        arm_b: (3,) its place, m forward, right, down of the IMU.
        rot_b: (3, 3) the rotation of its axes to b; None where it has none.
        axes: whose axes they are, for people.
    """

    name: str
    arm_b: FloatArray
    rot_b: FloatArray | None = None
    axes: str = "its"


def placed_devices(config: Config) -> list[Placed]:
    """Return IMUs, antennas and scanners of a configuration with their places."""
    found = [
        Placed(f"imu/{name}", np.zeros(3), np.array(imu.rotation_b_imu, np.float64)) for name, imu in config.imu.items()
    ]
    for name, gnss in config.gnss.items():
        found.append(Placed(f"antenna of gnss/{name}", np.array(gnss.lever_arm_m, np.float64)))
        if gnss.secondary_lever_arm_m is not None:
            second = np.array(gnss.secondary_lever_arm_m, np.float64)
            found.append(Placed(f"second antenna of gnss/{name}", second))
    for name, scanner in config.scanner.items():
        rot = np.eye(3) if scanner.installation is None else np.array(scanner.installation, np.float64)
        found.append(Placed(f"scanner/{name}", np.array(scanner_lever_arm_b(config, name)[1], np.float64), rot))
    return found


def geometry_lines(placed: Sequence[Placed]) -> list[str]:
    """Return a sentence for each device."""
    return [_sentence(one) for one in placed]


def _sentence(one: Placed) -> str:
    turned = "" if one.rot_b is None else f"{axes_words(one.rot_b)}"
    if one.name.startswith("imu/"):
        return f"{one.name}: {turned}"
    return f"{one.name}: {place_words(one.arm_b)}" + (f"; {turned}" if turned else "")


def place_words(arm_b: FloatArray) -> str:
    """Return a lever arm (3,), m in b, in words: ``0.10 m forward, 0.05 m left, 1.20 m above the IMU``."""
    parts = [
        f"{abs(value):.2f} m {AXES[axis][value < 0.0]}"
        for axis, value in enumerate(arm_b.tolist())
        if abs(value) >= 0.005
    ]
    if not parts:
        return "at the IMU"
    of = " of" if round(abs(float(arm_b[2])), 2) == 0.0 else ""
    return f"{', '.join(parts)}{of} the IMU"


def axes_words(rot_b: FloatArray) -> str:
    """Return where the axes of a device point, by the columns of its rotation (3, 3) to b."""
    return ", ".join(
        f"{'its ' if not number else ''}{letter} {_direction(rot_b[:, number])}" for number, letter in enumerate("xyz")
    )


def _direction(axis_b: FloatArray) -> str:
    """Return the direction of a unit vector (3,): the body's nearest axis, and the angle to it if there is one."""
    nearest = int(np.argmax(np.abs(axis_b)))
    word = TURNS[nearest][int(axis_b[nearest] < 0.0)]
    angle_deg = math.degrees(math.acos(min(1.0, abs(float(axis_b[nearest])))))
    if angle_deg <= STRAIGHT_DEG:
        return word
    rest = np.where(np.arange(3) == nearest, 0.0, axis_b)
    second = int(np.argmax(np.abs(rest)))
    return f"{word} and {angle_deg:.1f}° towards {TURNS[second][int(rest[second] < 0.0)]}"


def drawing(placed: Sequence[Placed]) -> list[str]:
    """Return the lines of a drawing: the side view from the right (forward is right, up is up) and, beside it, the view
    from above (forward is up, right is right). Columns of both are equally wide, in metres. Nothing is drawn where all
    is at one place, or farther apart than any aircraft is large.
    """
    arms = np.array([np.zeros(3), *(one.arm_b for one in placed if not one.name.startswith("imu/"))])
    if np.abs(arms).max() < STEPS_M[0]:
        return []
    letters = ["I", *(_letter(number) for number in range(len(arms) - 1))]
    named = [one.name for one in placed if not one.name.startswith("imu/")]
    side, above = arms[:, [0, 2]], np.stack([arms[:, 1], -arms[:, 0]], axis=1)  # columns to the right, rows down
    spans = [np.ptp(view, axis=0) for view in (side, above)]
    step_m = next(
        (
            step
            for step in STEPS_M
            if all(span[0] / step < COLUMNS - 1 and span[1] / (2.0 * step) < ROWS - 1 for span in spans)
        ),
        None,
    )
    if step_m is None:
        return []
    views = [_view(view, letters, step_m) for view in (side, above)]
    height = max(map(len, views))
    left = [*views[0], *[" " * len(views[0][0])] * (height - len(views[0]))]
    width = max(len(left[0]), len("from the right: forward →, up ↑"))
    lines = [f"{'from the right: forward →, up ↑':<{width}}   from above: right →, forward ↑"]
    lines += [
        f"{one:<{width}}   {other}".rstrip()
        for one, other in zip(left, [*views[1], *[""] * (height - len(views[1]))], strict=True)
    ]
    legend = ", ".join(f"{letter} {name}" for letter, name in zip(letters, ["IMU", *named], strict=True))
    many = f", {SEVERAL} several" if any(SEVERAL in line for view in views for line in view) else ""
    return [*lines, f"{legend}{many}; a column is {step_m:g} m, a row {2 * step_m:g} m"]


def _letter(number: int) -> str:
    letters = "ABCDEFGHJKLMNOPQRSTUVWXYZ"
    return letters[number] if number < len(letters) else "?"


def _view(places: FloatArray, letters: Sequence[str], step_m: float) -> list[str]:
    """Return the rows of one view; places are (n, 2): m to the right and down."""
    cells = np.rint((places - places.min(axis=0)) / (step_m, 2.0 * step_m)).astype(int)
    grid = [["·"] * (int(cells[:, 0].max()) + 1) for _ in range(int(cells[:, 1].max()) + 1)]
    for (column, row), letter in zip(cells.tolist(), letters, strict=True):
        grid[row][column] = letter if grid[row][column] == "·" else SEVERAL
    return ["".join(row) for row in grid]
