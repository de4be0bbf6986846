"""Signal maps of known CAN devices for `swath.drivers.imu.dbc`: messages are fixed, CAN identifiers set by the user."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from swath.drivers.can_frames import CAN_EFF_MASK, frame_id
from swath.drivers.imu.dbc.settings import SignalMap, map_signals
from swath.drivers.parser import DeviceSettings, DriverSettingsError


def profile_map(
    settings: DeviceSettings, contents: bytes, name: str, signals: Mapping[str, Any], *, prefix: str = ""
) -> SignalMap:
    """Return the signal map of a device whose driver includes a DBC of its messages.

    The message with the counter opens a sample unless the table's ``group`` says otherwise.

    Args:
        settings: the device's table; ``ids`` and ``extended_ids`` replace identifiers of the DBC.
        contents: the DBC's bytes.
        name: the DBC's name for error messages.
        signals: the role of each signal, as in ``[imu.NAME.signals]``.
        prefix: common beginning of its message names, which the keys of ``ids`` leave out.

    Raises:
        DriverSettingsError: a setting is invalid; the text names the key and a valid value.
    """
    if settings.config.get("sample") == "increment":
        raise DriverSettingsError(
            'sample: got "increment"; this device\'s messages hold rates; want "mean" or "instant"'
        )
    config = {**settings.config, "signals": signals, "dbc": name, "group": settings.config.get("group") or "first"}
    found = map_signals(DeviceSettings(settings.source, config, {"dbc": contents}))
    words = _can_ids(settings.config, {part.message.removeprefix(prefix): part.can_id for part in found.parts})
    parts = tuple(replace(part, can_id=words[part.message.removeprefix(prefix)]) for part in found.parts)
    return replace(found, parts=parts)


def _can_ids(config: Mapping[str, Any], defaults: Mapping[str, int]) -> dict[str, int]:
    """Return the ``can_id`` word of each message."""
    extended = bool(config.get("extended_ids"))
    given = dict(config.get("ids") or {})
    unknown = sorted(set(given) - set(defaults))
    if unknown:
        raise DriverSettingsError(f"ids.{unknown[0]}: unknown message; there are: {', '.join(sorted(defaults))}")
    numbers = {name: given.get(name, word & CAN_EFF_MASK) for name, word in defaults.items()}
    messages: dict[int, str] = {}
    for name, number in numbers.items():
        if messages.setdefault(number, name) != name:
            raise DriverSettingsError(f"ids: {messages[number]} and {name} are both 0x{number:X}; give each its own")
    try:
        return {name: frame_id(number, extended=extended) for name, number in numbers.items()}
    except ValueError as error:
        hint = "want 0 to 0x1FFFFFFF" if extended else "want 0 to 0x7FF; 29 bits need extended_ids = true"
        raise DriverSettingsError(f"ids: {error}; {hint}") from error
