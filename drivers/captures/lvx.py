"""Reads the files of Livox Viewer, ``.lvx`` and ``.lvx2``, as the datagrams of the heads that they hold.

``.lvx`` (version 1.1) stores each packet of SDK 1 behind the number of its head, so that its bytes are those that the
head sent. Sources: github.com/Livox-SDK/Livox-SDK @ 9306596, sample/lidar_lvx_file (the maker's writer);
github.com/Livox-SDK/livox_ros_driver @ 3d240d5, lvx_file.h and lds_lvx.cpp (the maker's reader).

``.lvx2`` (version 2.0) stores points behind a header of its own. The datagram of SDK 2 is built again from it:
docs/decisions/0038-lvx2-packages-become-datagrams.md. Source: Livox, "LVX2 Specifications" v1.0 (2023), all blocks.

A package has the time of its points and none of its arrival. `_Times` derives the log time.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np

from swath.drivers.captures.base import (
    CaptureDamageError,
    CapturedUnit,
    CaptureTally,
    open_capture,
    read_bytes,
    report,
    until_damage,
)
from swath.drivers.scanner.livox.layout import (
    AVIA,
    GPS_2,
    HAP,
    IMU_1,
    IMU_2,
    IMU_DTYPE,
    MID40,
    MID360,
    POINTS_1,
    POINTS_2,
    PPS_1,
    PPS_GPS_1,
    LivoxHead,
    utc_of,
)
from swath.drivers.transports.base import TransportError

SIGNATURE = b"livox_tech"
MAGIC = 0xAC0EA767
PUBLIC = struct.Struct("<16s4BI")  # signature, version, magic
PRIVATE = struct.Struct("<IB")  # duration of a frame in ms, number of heads
# code of the head, of its hub; index or id; (reserved;) type; extrinsics enabled; roll, pitch, yaw (°); x, y, z (m)
DEVICE_1, DEVICE_2 = struct.Struct("<16s16sBBB6f"), struct.Struct("<16s16sIxBB6f")
FRAME = struct.Struct("<QQQ")  # where it stands, where the next one does, its number
# index of the head; version, slot, id, reserved, status of the packet; type of time, type of data, time
PACKAGE_1 = struct.Struct("<B8xBB8s")
# version, id of the head, reserved, type of time, time, counter, type of data, bytes of points, frame, reserved
PACKAGE_2 = struct.Struct("<BIxB8sHBIB4x")
DATAGRAM_2 = struct.Struct("<B4H3B12xI8s")  # `HEADER_2`
SIZES_1 = {IMU_1: IMU_DTYPE.itemsize} | {key: kind.pulses * kind.dtype.itemsize for key, kind in POINTS_1.items()}
SIZES_2 = {IMU_2: IMU_DTYPE.itemsize} | {key: kind.dtype.itemsize for key, kind in POINTS_2.items()}  # of one point

SECOND_NS = 1_000_000_000
YEAR_2000_NS = 946_684_800 * SECOND_NS
USUAL_FRAME_MS = 50
LONGEST_FRAME_MS = 10_000
_MOST_AHEAD_NS = 10 * SECOND_NS  # more between packages than their frames allow is a clock that was set
_SKIPPED_AT_ONCE = 1 << 20
# livox_def.h, DeviceType; livox_lidar_def.h, LivoxLidarDeviceType: model, head, protocol
TYPES: dict[int, tuple[str, LivoxHead, str]] = {
    1: ("Mid-40", MID40, "livox-mid40"),
    2: ("Tele-15", AVIA, "livox-avia"),
    3: ("Horizon", AVIA, "livox-avia"),
    6: ("Mid-70", MID40, "livox-mid40"),
    7: ("Avia", AVIA, "livox-avia"),
    9: ("Mid-360", MID360, "livox-mid360"),
    10: ("HAP", HAP, "livox-hap"),
    15: ("HAP", HAP, "livox-hap"),
}


@dataclass(frozen=True, slots=True)
class LvxHead:
    """A head that a file names.

    Attributes:
        number: index, or id, by which packages name it.
        code: broadcast code or serial number; its number where the file gives none.
        kind: the maker's number of the model.
        enabled: True if the file says that its extrinsics are to be used.
        angles_deg: roll, pitch, yaw that the file claims: head's axes = Rz(yaw) Ry(pitch) Rx(roll) to those of the file
            (lds.cpp, EulerAnglesToRotationMatrix).
        place_m: x, y, z of the head's origin in the axes of the file.
    """

    number: int
    code: str
    kind: int
    enabled: bool
    angles_deg: tuple[float, float, float]
    place_m: tuple[float, float, float]

    @property
    def model(self) -> str:
        """The maker's name of the model."""
        return f"Livox {TYPES[self.kind][0]}" if self.kind in TYPES else f"Livox head of type {self.kind}"

    @property
    def protocol(self) -> str:
        """The protocol that decodes it; empty for an unknown type."""
        return TYPES[self.kind][2] if self.kind in TYPES else ""

    def words(self) -> str:
        """Return code, model and the installation that the file claims, for people."""
        roll, pitch, yaw = self.angles_deg
        x, y, z = self.place_m
        return (
            f"{self.code}: {self.model}; the file claims roll {roll:.2f}°, pitch {pitch:.2f}°, yaw {yaw:.2f}°, "
            f"x {x:.3f} m, y {y:.3f} m, z {z:.3f} m{'' if self.enabled else ' (not to be used)'}"
        )


@dataclass(frozen=True, slots=True)
class LvxFile:
    """The beginning of a file: SDK 1 or 2, duration of a frame in ns, and heads by number."""

    sdk: int
    frame_ns: int
    heads: dict[int, LvxHead]

    def code_of(self, number: int) -> str:
        """Return the code of a head, also of one that the file does not name."""
        return self.heads[number].code if number in self.heads else f"head {number}"


@dataclass(frozen=True, slots=True)
class _Package:
    frame: int
    number: int
    time_type: int
    time: bytes
    data: bytes
    last_ns: int  # from the first point to the last


def is_lvx(head: bytes) -> bool:
    """Return whether a file with these first bytes is one of Livox Viewer."""
    return head.startswith(SIGNATURE)


def read_lvx_heads(path: Path) -> LvxFile:
    """Read the beginning of a file.

    Raises:
        TransportError: it is none, of another version, or ends in its beginning.
    """
    with open_capture(path) as stream:
        return _Reader(stream, path, CaptureTally()).beginning()


def tells_time(path: Path) -> bool:
    """Return whether the file's first package has UTC, so that no start need be given; True for a file without any.

    Raises:
        TransportError: as `read_lvx_heads`.
    """
    with open_capture(path) as stream:
        reader = _Reader(stream, path, CaptureTally())
        file = reader.beginning()
        first = next(until_damage(reader.packages(file), CaptureTally()), None)
    return first is None or _utc_ns(file.sdk, first.time_type, first.time) is not None


def read_lvx(
    path: Path | str, start_ns: int | None = None, tally: CaptureTally | None = None
) -> Iterator[CapturedUnit]:
    """Read the datagrams of all heads in the file's order; ``channel`` is the code of the head.

    Args:
        path: the file, possibly gzipped.
        start_ns: log time of the first frame, where packages have no UTC; those with UTC have it as log time.
        tally: counts damage; where None, it is raised.

    Raises:
        TransportError: as `read_lvx_heads`, or the first package has no UTC and no start is given; without tally also:
            the file is cut short or damaged.
    """
    return until_damage(_units(Path(path), start_ns, tally), tally)


def _units(path: Path, start_ns: int | None, tally: CaptureTally | None) -> Iterator[CapturedUnit]:
    with open_capture(path) as stream:
        reader = _Reader(stream, path, tally)
        file = reader.beginning()
        times = _Times(file, start_ns)
        for package in reader.packages(file):
            time_ns = times.of(package)
            if time_ns is None:
                raise TransportError(f"{path}: its packages have no UTC; give the time at which it begins (--start)")
            yield CapturedUnit(time_ns + package.last_ns, package.data, file.code_of(package.number))


class _Reader:
    """Reads blocks in their order and knows where it stands in the file."""

    def __init__(self, stream: BufferedIOBase, path: Path, tally: CaptureTally | None) -> None:
        self._stream, self._path, self._tally = stream, path, tally
        self._at = 0

    def _read(self, count: int) -> bytes:
        data = read_bytes(self._stream, count, self._path)
        self._at += len(data)
        return data

    def _whole(self, count: int, what: str) -> bytes:
        begin = self._at
        data = self._read(count)
        if len(data) < count:
            raise CaptureDamageError(f"{self._path}: ends in {what} at byte {begin}")
        return data

    def beginning(self) -> LvxFile:
        """Read public header, private header and the heads."""
        head = self._read(PUBLIC.size)
        if len(head) < PUBLIC.size or not is_lvx(head):
            raise TransportError(f"{self._path}: is not a file of Livox Viewer, or ends in its header")
        _, major, minor, _, _, magic = PUBLIC.unpack(head)
        if (major, min(minor, 1)) not in ((1, 1), (2, 0), (2, 1)):
            raise TransportError(
                f"{self._path}: is of version {major}.{minor} of Livox Viewer's format; want 1.1 (.lvx) or 2.0 (.lvx2)"
            )
        if magic != MAGIC:
            report(self._tally, f"{self._path}: has the magic code {magic:#x} instead of {MAGIC:#x}")
        frame_ms, count = PRIVATE.unpack(self._whole(PRIVATE.size, "its header"))
        layout = DEVICE_1 if major == 1 else DEVICE_2
        found = [self._head(layout, self._whole(layout.size, "its list of heads")) for _ in range(count)]
        if not 0 < frame_ms <= LONGEST_FRAME_MS:
            frame_ms = USUAL_FRAME_MS
        return LvxFile(major, frame_ms * 1_000_000, {head.number: head for head in found})

    @staticmethod
    def _head(layout: struct.Struct, block: bytes) -> LvxHead:
        code, _, number, kind, enabled, *claimed = layout.unpack(block)
        text = "".join(letter for letter in code.partition(b"\0")[0].decode("ascii", "replace") if letter.isalnum())
        roll, pitch, yaw, x, y, z = (value if math.isfinite(value) else 0.0 for value in claimed)
        return LvxHead(number, text or str(number), kind, bool(enabled), (roll, pitch, yaw), (x, y, z))

    def packages(self, file: LvxFile) -> Iterator[_Package]:
        """Yield the packages of all frames, also of a frame that the file cuts off."""
        number = 0
        while head := self._read(FRAME.size):
            at = self._at - len(head)
            if len(head) < FRAME.size:
                raise CaptureDamageError(f"{self._path}: ends in a frame's header at byte {at}")
            here, end, _ = FRAME.unpack(head)
            if here != at:
                report(self._tally, f"{self._path}: the frame at byte {at} says that it is at byte {here}")
            if end < self._at:
                raise CaptureDamageError(f"{self._path}: the frame at byte {at} says that the next is at byte {end}")
            yield from self._of_frame(file, number, end)
            number += 1

    def _of_frame(self, file: LvxFile, frame: int, end: int) -> Iterator[_Package]:
        read = self._first if file.sdk == 1 else self._second
        while self._at < end:
            at = self._at
            package = read(file, frame, end)
            if isinstance(package, str):
                report(self._tally, f"{self._path}: {package} at byte {at}; the rest of its frame is left out")
                while self._at < end and self._read(min(end - self._at, _SKIPPED_AT_ONCE)):
                    pass
                return
            yield package

    def _first(self, file: LvxFile, frame: int, end: int) -> _Package | str:
        """Return the next package of SDK 1, or what is wrong with it."""
        if self._at + PACKAGE_1.size > end:
            return "a package longer than its frame"
        head = self._whole(PACKAGE_1.size, "a package")
        number, time_type, data_type, time = PACKAGE_1.unpack(head)
        size = SIZES_1.get(data_type)
        if size is None:
            return f"a package with the unknown type of data {data_type}"
        if self._at + size > end:
            return "a package longer than its frame"
        data = head[1:] + self._whole(size, "a package")
        pulses, known = POINTS_1[data_type].pulses if data_type in POINTS_1 else 1, file.heads.get(number)
        return _Package(frame, number, time_type, time, data, _last_ns(known, pulses))

    def _second(self, file: LvxFile, frame: int, end: int) -> _Package | str:
        """Return the next package of SDK 2 as a datagram, or what is wrong with it."""
        if self._at + PACKAGE_2.size > end:
            return "a package longer than its frame"
        head = self._whole(PACKAGE_2.size, "a package")
        version, number, time_type, time, counter, data_type, size, frame_count = PACKAGE_2.unpack(head)
        if self._at + size > end:
            return "a package longer than its frame"
        if size + DATAGRAM_2.size > 0xFFFF:
            return f"a package of {size} bytes"
        points, each = self._whole(size, "a package"), SIZES_2.get(data_type, 1)
        pulses = size // each
        last_ns = _last_ns(file.heads.get(number), pulses)
        datagram = DATAGRAM_2.pack(
            version,
            DATAGRAM_2.size + size,
            round(last_ns / 100),
            pulses,
            counter,
            frame_count,
            data_type,
            time_type,
            0,
            time,
        )
        return _Package(frame, number, time_type, time, datagram + points, last_ns)


def _last_ns(head: LvxHead | None, pulses: int) -> int:
    """Return the time from the first of so many pulses to the last; 0 for an unknown model."""
    kind = TYPES.get(head.kind) if head is not None else None
    return 0 if kind is None or pulses < 2 else round((pulses - 1) * SECOND_NS / kind[1].pulses_hz)


@dataclass(slots=True)
class _Latest:
    time_type: int
    stamp: int
    frame: int
    time_ns: int


class _Times:
    """Derives log times from the stamps of packages.

    UTC is the log time itself. Other stamps go on from the head's package before, or, where they cannot (the first of a
    head, a clock that was set, another type of time), by the count of frames.
    """

    def __init__(self, file: LvxFile, start_ns: int | None) -> None:
        self._file = file
        self._heads: dict[int, _Latest] = {}
        self._newest = None if start_ns is None else (0, start_ns)  # frame and its time

    def of(self, package: _Package) -> int | None:
        """Return the log time of the package's first point; None if nothing gives the time of the file's first."""
        before = self._heads.get(package.number)
        stamp = int.from_bytes(package.time, "little")
        time_ns = _utc_ns(self._file.sdk, package.time_type, package.time)
        if time_ns is None and before is not None:
            time_ns = before.time_ns + self._step(before, package, stamp)
        if time_ns is None and self._newest is not None:
            frame, then_ns = self._newest
            time_ns = then_ns + (package.frame - frame) * self._file.frame_ns
        if time_ns is None:
            return None
        self._heads[package.number] = _Latest(package.time_type, stamp, package.frame, time_ns)
        if self._newest is None or package.frame > self._newest[0]:
            self._newest = package.frame, time_ns
        return time_ns

    def _step(self, before: _Latest, package: _Package, stamp: int) -> int:
        passed_ns = (package.frame - before.frame) * self._file.frame_ns
        if package.time_type != before.time_type:
            return passed_ns
        step_ns = stamp - before.stamp
        if self._file.sdk == 1 and package.time_type == PPS_1:  # restarts at each pulse
            step_ns = step_ns % SECOND_NS
            step_ns += round((passed_ns - step_ns) / SECOND_NS) * SECOND_NS
        return step_ns if -SECOND_NS <= step_ns <= passed_ns + _MOST_AHEAD_NS else passed_ns


def _utc_ns(sdk: int, time_type: int, time: bytes) -> int | None:
    """Return nanoseconds since 1970 in UTC; None where the time is none of UTC."""
    if sdk == 1 and time_type == PPS_GPS_1:
        hour_ns, microsecond = _hour_ns(time[:4]), int.from_bytes(time[4:], "little")
        return None if hour_ns is None or microsecond > 3_601_000_000 else hour_ns + microsecond * 1000
    if sdk == 2 and time_type == GPS_2 and (time_ns := int.from_bytes(time, "little")) >= YEAR_2000_NS:
        return time_ns
    return None


@lru_cache(maxsize=64)
def _hour_ns(hour: bytes) -> int | None:
    """Return the begin of an hour, its first four bytes in time type 3 of SDK 1."""
    time: Any = np.frombuffer(hour + bytes(4), dtype=np.uint8)[np.newaxis]
    time_ns, good = utc_of(time)
    return int(time_ns[0]) if good[0] else None
