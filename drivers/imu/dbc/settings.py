"""Resolves the configuration's signal names to signals, parts and units (`swath.drivers.imu.dbc.parser`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from math import radians
from typing import Any

from swath.drivers.can_frames import CAN_EFF_FLAG
from swath.drivers.imu.dbc.groups import GroupRule
from swath.drivers.imu.dbc.j1939 import FLAGS, is_j1939, pgn_mask
from swath.drivers.imu.dbc.signals import FoundSignal, SignalLayout, find_signal, load_database
from swath.drivers.parser import DeviceSettings, DriverSettingsError

STANDARD_GRAVITY = 9.80665  # m/s², CGPM 1901
UNITS = {  # unit in the spelling of `_plain_unit` -> factor to SI
    "specific_force": {"m/s2": 1.0, "m/s/s": 1.0, "m.s-2": 1.0, "g": STANDARD_GRAVITY, "mg": 0.001 * STANDARD_GRAVITY},
    "angular_rate": {"rad/s": 1.0, "rad.s-1": 1.0, "deg/s": radians(1.0), "deg/h": radians(1.0) / 3600.0},
}
INCREMENT_UNITS = {
    "specific_force": {"m/s": 1.0, "m.s-1": 1.0},
    "angular_rate": {"rad": 1.0, "deg": radians(1.0)},
}
RIGHT_UNITS = {"specific_force": "m/s2, g or mg", "angular_rate": "deg/s, rad/s or deg/h"}
RIGHT_INCREMENTS = {"specific_force": "m/s", "angular_rate": "rad or deg"}
VECTORS = ("specific_force", "angular_rate")
SCALARS = ("sample_ticks", "pps_ticks", "temperature", "status", "packet_counter")
INTEGERS = {"sample_ticks": "counter", "pps_ticks": "counter", "status": "status word", "packet_counter": "counter"}
DEFAULT_TICK_HZ = 1_000_000


@dataclass(frozen=True, slots=True)
class Part:
    """One kind of frame: a message, or its version under some multiplexer values.

    Attributes:
        can_id: ``can_id`` word, extended flag included.
        message: its name in the DBC.
        selector, selector_values: the multiplexer and its values; None selects every frame of the message.
        needs_bytes: minimum data length that contains its configured signals.
        id_mask: bits of a frame's ``can_id`` word that must equal those of `can_id`; all of them, except in a J1939
            message, whose priority is free, and its source address too where `any_source` is true.
        j1939: whether the message is a J1939 parameter group, whose values have codes for "error" and "not available".
        any_source: whether one of the devices that send the message is chosen.
    """

    can_id: int
    message: str
    selector: SignalLayout | None
    selector_values: frozenset[int]
    needs_bytes: int
    id_mask: int = 0xFFFF_FFFF
    j1939: bool = False
    any_source: bool = False


@dataclass(frozen=True, slots=True)
class MappedSignal:
    """A configured signal, the number of the part that carries it, and its factor to SI."""

    layout: SignalLayout
    part: int
    factor: float = 1.0


@dataclass(frozen=True, slots=True)
class SignalMap:
    """Holds everything that `DbcParser` needs from the configuration.

    Attributes:
        parts: the frames that make a sample, then those beside it (a PPS latch or a temperature in a message of its
            own), whose values hold until the next one.
        grouped: number of `parts` that make a sample.
        vectors: specific force x y z, angular rate x y z.
        sample_ticks, pps_ticks, temperature, status, packet_counter: None where not configured.
        tick_hz: rate of the counters.
        rule, key_part: rule by which frames make samples, and its opening or closing part.
        rule_is_said: True if the configuration gives the rule or one part needs none; else frame spacing may replace
            it.
    """

    parts: tuple[Part, ...]
    grouped: int
    vectors: tuple[MappedSignal, ...]
    sample_ticks: MappedSignal | None
    pps_ticks: MappedSignal | None
    temperature: MappedSignal | None
    status: MappedSignal | None
    packet_counter: MappedSignal | None
    tick_hz: Fraction
    rule: GroupRule
    key_part: int
    rule_is_said: bool = True


@dataclass(slots=True)
class _PartList:
    """Collects the parts that contain signals."""

    parts: list[Part] = field(default_factory=list)

    def number(self, found: FoundSignal) -> int:
        """Return the number of the part that carries a signal; add the part where it is new."""
        mine = [number for number, part in enumerate(self.parts) if part.can_id == found.can_id]
        for number in mine:
            part = self.parts[number]
            if found.selector is None or part.selector_values == found.selector_values:
                if found.selector is None and len(mine) > 1:
                    raise DriverSettingsError(
                        f"signal {found.layout.name} is in every frame of {found.message}, whose other signals are "
                        "multiplexed in several: it is undefined which frame completes a sample"
                    )
                self.parts[number] = self._widened(part, found)
                return number
            if part.selector is None:
                self.parts[number] = self._widened(part, found, narrowed=True)
                return number
        needs = max(found.layout.needs_bytes, found.selector.needs_bytes if found.selector else 0)
        self.parts.append(Part(found.can_id, found.message, found.selector, found.selector_values, needs))
        return len(self.parts) - 1

    @staticmethod
    def _widened(part: Part, found: FoundSignal, *, narrowed: bool = False) -> Part:
        """Return the part with room for one more signal; ``narrowed`` limits it to the signal's multiplexer values."""
        chooser = found if narrowed else part
        needs = max(part.needs_bytes, found.layout.needs_bytes, found.selector.needs_bytes if found.selector else 0)
        return replace(part, selector=chooser.selector, selector_values=chooser.selector_values, needs_bytes=needs)


def map_signals(settings: DeviceSettings) -> SignalMap:
    """Find all configured signals in the device's DBC.

    Raises:
        DriverSettingsError: a setting is invalid; the text names the key, signal or unit, and a valid value.
    """
    config = settings.config
    if "dbc" not in settings.files:
        raise DriverSettingsError("dbc: missing; want the DBC file")
    file_name = str(config.get("dbc") or "the DBC file")
    database = load_database(settings.files["dbc"])
    found = _find_all(config, database, file_name)
    if "pps_ticks" in found and "sample_ticks" not in found:
        raise DriverSettingsError("signals.pps_ticks needs signals.sample_ticks, the running value of the same counter")
    parts = _PartList()
    numbers = {
        key: [parts.number(signal) for signal in found[key]] for key in (*VECTORS, "sample_ticks") if key in found
    }
    grouped = len(parts.parts)
    numbers |= {key: [parts.number(signal) for signal in found[key]] for key in SCALARS[1:] if key in found}
    factors = _factors(config, found, file_name)
    _refuse_axis_twice(config["signals"])

    def scalar(key: str) -> MappedSignal | None:
        return MappedSignal(found[key][0].layout, numbers[key][0]) if key in found else None

    ticks = scalar("sample_ticks")
    rule = _group_rule(config, ticks, grouped)
    return SignalMap(
        parts=tuple(_addressed(part, database, config) for part in parts.parts),
        grouped=grouped,
        vectors=tuple(
            MappedSignal(signal.layout, number, factor)
            for key in VECTORS
            for signal, number, factor in zip(found[key], numbers[key], factors[key], strict=True)
        ),
        sample_ticks=ticks,
        pps_ticks=scalar("pps_ticks"),
        temperature=scalar("temperature"),
        status=scalar("status"),
        packet_counter=scalar("packet_counter"),
        tick_hz=_tick_hz(config, ticks),
        rule=rule,
        key_part=ticks.part if ticks else 0,
        rule_is_said=grouped == 1 or bool(config.get("group")),
    )


def _addressed(part: Part, database: Any, config: Mapping[str, Any]) -> Part:
    """Return the part with the bits of the identifier that its frames must have."""
    address = config.get("source_address")
    extended = bool(part.can_id & CAN_EFF_FLAG)
    if not extended:
        if address is not None:
            raise DriverSettingsError(
                f"source_address: message {part.message} has an 11-bit identifier, which contains no address; "
                "remove the key"
            )
        return part
    message = next(message for message in database.messages if message.name == part.message)
    if address is None and not is_j1939(database, message):
        return part
    mask = pgn_mask(part.can_id)
    twins = sum(other.is_extended_frame and (other.frame_id ^ part.can_id) & mask == 0 for other in database.messages)
    any_source = address is not None or twins == 1
    return replace(part, id_mask=FLAGS | mask | (0 if any_source else 0xFF), j1939=True, any_source=any_source)


def _find_all(config: Mapping[str, Any], database: Any, file_name: str) -> dict[str, list[FoundSignal]]:
    """Return the configured signals by key, vectors with their three components."""
    names = {key: value for key, value in dict(config.get("signals") or {}).items() if value}
    unknown = sorted(set(names) - {*VECTORS, *SCALARS})
    if unknown:
        raise DriverSettingsError(f"signals.{unknown[0]}: unknown signal; there are: {', '.join((*VECTORS, *SCALARS))}")
    found: dict[str, list[FoundSignal]] = {}
    for key in VECTORS:
        value = names.get(key)
        if not isinstance(value, list | tuple) or len(value) != 3:
            raise DriverSettingsError(f"signals.{key} must name three signals, x, y and z, as MESSAGE.signal")
        found[key] = [find_signal(database, str(path), file_name) for path in value]
    for key in SCALARS:
        if key in names:
            found[key] = [find_signal(database, str(names[key]), file_name)]
    for key, kind in INTEGERS.items():
        if key in found and found[key][0].layout.is_float:
            raise DriverSettingsError(f"signals.{key}: {names[key]} is a float; a {kind} must be an integer")
    return found


def _refuse_axis_twice(names: Mapping[str, Any]) -> None:
    axes = [str(path) for key in VECTORS for path in names[key]]
    twice = next((path for path in axes if axes.count(path) > 1), None)
    if twice is not None:
        raise DriverSettingsError(f"signals: {twice} is named for two axes; give each axis its own signal")


def _factors(
    config: Mapping[str, Any], found: Mapping[str, list[FoundSignal]], file_name: str
) -> dict[str, list[float]]:
    """Return the factors to SI of the vectors' components; increments are divided by the nominal interval."""
    increment = config.get("sample") == "increment"
    rate_hz = float(config.get("rate_hz") or 0.0)
    if increment and rate_hz <= 0.0:
        raise DriverSettingsError('rate_hz: needed with sample = "increment", to divide by the interval')
    known, right = (INCREMENT_UNITS, RIGHT_INCREMENTS) if increment else (UNITS, RIGHT_UNITS)
    given = dict(config.get("units") or {})
    factors: dict[str, list[float]] = {}
    for key in VECTORS:
        factors[key] = []
        for signal in found[key]:
            name, unit = signal.layout.name, signal.layout.unit
            factor = known[key].get(_plain_unit(unit))
            if name in given:
                factor = _given_factor(name, str(given.pop(name)), known[key], right[key], (factor, unit, file_name))
            if factor is None:
                raise DriverSettingsError(
                    f'signal {name} of {file_name} has unit "{unit}"; {key} needs {right[key]}, '
                    f'which units = {{ "{name}" = "…" }} can give'
                )
            factors[key].append(factor * (rate_hz if increment else 1.0))
    for name in given:
        raise DriverSettingsError(f"units: {name} is no signal of specific_force or angular_rate; remove it")
    return factors


def _given_factor(
    name: str, unit: str, known: Mapping[str, float], right: str, stated: tuple[float | None, str, str]
) -> float:
    """Return the factor of a unit that the configuration gives; ``stated`` is the DBC's factor, unit and file name."""
    factor = known.get(_plain_unit(unit))
    if factor is None:
        raise DriverSettingsError(f'units: {name} has "{unit}"; want {right}')
    if stated[0] is not None and stated[0] != factor:
        raise DriverSettingsError(
            f'units: {name} has "{unit}", but {stated[2]} says "{stated[1]}"; remove the entry or correct the DBC file'
        )
    return factor


def _plain_unit(unit: str) -> str:
    """Normalise the spelling of a unit: lower case, no blanks or carets, deg for °."""
    plain = unit.strip().lower().replace(" ", "").replace("^", "").replace("²", "2").replace("·", ".")
    plain = plain.replace("°", "deg").replace("degrees", "deg").replace("degree", "deg").replace("sec", "s")
    return plain.replace("dps", "deg/s") if plain == "dps" else plain


def _group_rule(config: Mapping[str, Any], ticks: MappedSignal | None, grouped: int) -> GroupRule:
    """Return ``group`` of the configuration; without ticks, or with one frame a sample, the rule is ``repeat``."""
    group = config.get("group") or "last"
    if group not in ("last", "first"):
        raise DriverSettingsError(f'group: got "{group}", want "last" or "first"')
    if ticks is None or grouped == 1:
        return "repeat"
    return "first" if group == "first" else "last"


def _tick_hz(config: Mapping[str, Any], ticks: MappedSignal | None) -> Fraction:
    """Return the exact rate of the counters."""
    value = config.get("tick_hz")
    if ticks is None:
        return Fraction(1)
    if value is None:
        return Fraction(DEFAULT_TICK_HZ)
    if not isinstance(value, int | float) or value <= 0:
        raise DriverSettingsError(f"tick_hz: got {value}, want counts per second, above 0")
    return Fraction(value).limit_denominator(1000)
