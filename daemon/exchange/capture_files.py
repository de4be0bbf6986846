"""Determines the kind of each file given to `swath import`, and the device that it belongs to."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import tzinfo
from itertools import islice
from pathlib import Path
from typing import Any

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.exchange.bags import BagChoice
from swath.daemon.exchange.captures import CAN_LOGS, Capture, has_times
from swath.daemon.exchange.export import MANIFEST
from swath.daemon.exchange.routes import Port, Routes
from swath.daemon.exchange.sidecar import SUFFIX
from swath.daemon.exchange.tables import RECORDS, is_folder_of_tables, settle_tables, table_of, tables_of_folder
from swath.daemon.log.format import LogError, safe_attachment_path
from swath.drivers.captures.opening import (
    BareTime,
    CaptureTally,
    FileClock,
    FileTime,
    LvxHead,
    bag_kind,
    can_log_kind,
    can_log_time,
    is_lvx,
    is_pcap,
    is_table,
    read_beginning,
    read_can_log,
    read_lvx_heads,
    tells_time,
)
from swath.drivers.transports.base import TransportError

_LOOKED_AT_BYTES = 65_536
_MAX_MANIFEST_BYTES = 1 << 20
_KIND_OF_PORT = {
    "udp": "pcap",
    "can": "candump",
    "serial": "serial",
    "tcp": "serial",
    "ntrip": "serial",
    "pps": "pps",
}
_FORMS = {
    "pcap": "a pcap file",
    "candump": "a log of candump",
    "asc": "an ASC log",
    "blf": "a BLF log",
    "trc": "a TRC trace",
    "mf4": "an MF4 file",
    "serial": "a file of serial bytes",
    "pps": "a file of edges",
}
_NO_CAPTURE = {  # first bytes of files that hold device bytes in a format that cannot be imported
    b"\x89MCAP0\r\n": "MCAP, but no ROS 2 bag",
    b"\x28\xb5\x2f\xfd": "compressed with zstd; of a bag give the folder with its metadata.yaml",
    b"\x34\xcd\xb2\xa1": "a pcap file of a modified libpcap, which Wireshark's editcap turns into pcapng",
    b"snoop\0": "a snoop file, which Wireshark's editcap turns into pcapng",
    b"GMBU": "a file of Network Monitor, which Wireshark's editcap turns into pcapng",
}
_READABLE = "pcap, pcapng, candump, ASC, BLF, TRC, MF4, lvx, CSV, Parquet or a ROS bag"
_LOOKED_AT_FRAMES = 10_000
_WANTED = (
    "want kind/name=FILE, kind/name:<CAN interface>=FILE, kind/name:<UDP or TCP port>=FILE or kind/name:<topic>=BAG"
)


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """The options of the command line besides the files.

    Attributes:
        named: ``kind/name[/aux][:selector]=FILE``, as given.
        start_ns, baud: start time and baud rate of serial files without times, by source, "" for all.
        keep_copies: keep packets that were captured twice.
        zone: of local times that name no zone; None: not given.
    """

    named: Sequence[str] = ()
    start_ns: Mapping[str, int] = field(default_factory=dict)
    baud: Mapping[str, float] = field(default_factory=dict)
    keep_copies: bool = False
    zone: tzinfo | None = None


def find_captures(routes: Routes, files: Sequence[Path], options: ImportOptions) -> list[Capture]:
    """Return every file with its kind and device.

    Raises:
        UserError: one line for each fault: a file without device or times, or a file that cannot be read.
    """
    found: dict[tuple[Path, str, str | None], Capture] = {}
    wrong: list[str] = [
        f"{source}: is not a source of the configuration; there are: {', '.join(routes.ports) or 'none'}"
        for source in dict.fromkeys([*options.start_ns, *options.baud])
        if source and source not in routes.ports
    ]
    unreadable = 0
    items: list[str | Path] = [*options.named, *files]
    bags = BagChoice(routes)
    for item in items:
        try:
            for capture in _named(routes, item, bags) if isinstance(item, str) else _found(routes, item, bags):
                _settle(capture, options, routes)
                source = capture.port.source if capture.port is not None else ""
                found[capture.path, source, capture.selector] = capture
        except (UserError, TransportError) as error:
            wrong.append(one_line(str(error)))
            unreadable += isinstance(error, TransportError)
    try:
        captures = [*found.values(), *bags.captures()]
    except UserError as error:
        wrong += map(one_line, error.message.splitlines())
        captures = []
    settle_tables(captures)
    if not captures and not wrong:
        wrong.append("nothing to import; give captures or the folder of an export")
    if wrong:
        raise UserError("\n".join(wrong), ExitCode.IO if unreadable == len(wrong) else ExitCode.USAGE)
    return captures


def _named(routes: Routes, text: str, bags: BagChoice) -> list[Capture]:
    """Parse ``--source kind/name:selector=FILE``; a bag goes to ``bags``."""
    name, equals, file = text.partition("=")
    source, _, selector = name.partition(":")
    if not equals or not file or not source:
        raise UserError(f"--source {text}: {_WANTED}")
    path = Path(file)
    port = _port(routes, source, f"--source {text}")
    kind = _kind(path, b"" if bag_kind(path, b"") else read_beginning(path, _LOOKED_AT_BYTES)[0])
    if kind == "lvx":
        return [_named_heads(path, port, selector)]
    if kind == "bag":
        bags.name(path, port, selector)
        return []
    if kind == "serial" and is_table(path) and port.protocol == RECORDS:
        return [table_of(routes, path, port)]
    wanted = _KIND_OF_PORT[port.kind]
    if kind == "pcap" and port.kind == "serial" and not selector:
        raise UserError(
            f"{path}: is a pcap file, but {source} uses serial; want a file of serial bytes, or the TCP port that sent "
            f"them: --source {source}:PORT={path}"
        )
    if port.kind == "pps" if kind == "pcap" else port.kind != "can" if kind in CAN_LOGS else port.kind == "udp":
        raise UserError(f"{path}: is {_FORMS[kind]}, but {source} uses {port.kind}; want {_FORMS[wanted]}")
    return [Capture(path, kind if kind == "pcap" or kind in CAN_LOGS else wanted, port, selector or None)]


def _port(routes: Routes, source: str, where: str) -> Port:
    port = routes.ports.get(source)
    if port is None:
        known = ", ".join(routes.ports) or "none"
        raise UserError(f"{where}: {source} is not a source of the configuration; there are: {known}")
    return port


def _found(routes: Routes, path: Path, bags: BagChoice) -> list[Capture]:
    """Return a file whose units identify their own device, or all files of an export's folder; a bag goes to
    ``bags``.
    """
    if path.is_dir() and not bag_kind(path, b""):
        return tables_of_folder(routes, path) if is_folder_of_tables(path) else _of_export(routes, path)
    head, damage = (b"", "") if path.is_dir() else read_beginning(path, _LOOKED_AT_BYTES)
    kind = _kind(path, head)
    if kind == "bag":
        bags.add(path)
        return []
    if kind == "serial" and is_table(path):
        return [table_of(routes, path, None)]
    if kind == "serial":
        if damage:
            raise TransportError(f"{path}: cannot be read: {damage}")
        if other := next((what for magic, what in _NO_CAPTURE.items() if head.startswith(magic)), ""):
            raise UserError(f"{path}: is {other}; want {_READABLE}")
        raise UserError(f"{path}: is not {_READABLE}; if it holds the bytes of a device, use --source kind/name={path}")
    if kind == "lvx":
        return [_found_heads(routes, path)]
    if routes.described(kind) == "none":
        what = "UDP or TCP port and no CAN bus" if kind == "pcap" else "CAN bus"
        raise UserError(f"{path}: the configuration has no {what} for it")
    if kind in CAN_LOGS:
        _refuse_several(path, kind, routes)
    return [Capture(path, kind)]


def _refuse_several(path: Path, kind: str, routes: Routes) -> None:
    """Refuse a log of several numbered channels for a configuration with one bus, which may be any of them."""
    if kind == "candump" or len(routes.buses()) != 1:
        return
    units = read_can_log(path, kind, FileClock(0), CaptureTally())
    counts = Counter(unit.channel for unit in islice(units, _LOOKED_AT_FRAMES))
    [bus] = routes.buses()
    if len(counts) > 1 and not {*counts} & {*routes.bus_names()}:
        held = ", ".join(f"{channel} ({count})" for channel, count in sorted(counts.items()))
        raise UserError(f"{path}: holds channels {held}; give --source {bus}:CHANNEL={path}")


def _named_heads(path: Path, port: Port, code: str) -> Capture:
    """Return a file of Livox Viewer whose head, or the one with this code, is the source that the user named."""
    heads = _heads(path)
    chosen = [head for head in heads.values() if not code or head.code == code]
    if port.kind != "udp" or not port.source.startswith("scanner/"):
        raise UserError(f"{path}: is a file of Livox Viewer, but {port.source} is not a scanner by UDP")
    if len(chosen) != 1:
        raise UserError(
            f"{path}: holds {_listed(heads)}; give --source {port.source}:CODE={path}, CODE being one of them"
        )
    if chosen[0].protocol not in ("", port.protocol):
        raise UserError(
            f'{path}: {_listed(heads)} has protocol "{chosen[0].protocol}", but {port.source} "{port.protocol}"; '
            "want a source of that protocol"
        )
    return Capture(path, "lvx", port, code or None, heads=heads, head_ports={chosen[0].code: port})


def _found_heads(routes: Routes, path: Path) -> Capture:
    """Return a file of Livox Viewer whose heads are found by serial number or protocol."""
    heads = _heads(path)
    ports = routes.of_heads(heads.values())
    if not ports:
        raise UserError(
            f"{path}: holds {_listed(heads)}, but the configuration has {routes.described('lvx')}; "
            f"give --source scanner/NAME:CODE={path}, or serial and protocol in [scanner.NAME]"
        )
    return Capture(path, "lvx", heads=heads, head_ports=ports)


def _heads(path: Path) -> dict[str, LvxHead]:
    return {head.code: head for head in read_lvx_heads(path).heads.values()}


def _listed(heads: Mapping[str, LvxHead]) -> str:
    named = [f"{head.code} ({head.model}, {head.protocol or 'no protocol'})" for head in heads.values()]
    return ", ".join(named) or "no head"


def _kind(path: Path, head: bytes) -> str:
    """Recognise a file by its beginning: pcap, lvx, a log of a CAN bus or a bag, else the bytes of a serial line."""
    if bag_kind(path, head):
        return "bag"
    if is_pcap(head):
        return "pcap"
    if is_lvx(head):
        return "lvx"
    return can_log_kind(head) or "serial"


def _settle(capture: Capture, given: ImportOptions, routes: Routes) -> None:
    """Apply the command line's options to a file: its times, and whether copies stay."""
    capture.keep_copies = given.keep_copies
    if capture.kind in CAN_LOGS:
        _settle_can(capture, given, routes)
    if capture.kind == "lvx":
        _settle_heads(capture, given)
    if capture.kind != "serial" or has_times(capture.path):
        return
    assert capture.port is not None
    source, options = capture.port.source, capture.port.options
    start_ns = given.start_ns.get(source, given.start_ns.get(""))
    if start_ns is None:
        raise UserError(
            f"{capture.path}: has no times, and no {capture.path.name}.tag or table of arrivals is beside it; "
            "give --start"
        )
    baud = given.baud.get(source, given.baud.get("", float(options.get("baud", 0))))
    parity = options.get("parity", "N") != "N"
    bits = 1 + int(options.get("bytesize", 8)) + parity + float(options.get("stopbits", 1))
    capture.time = BareTime(start_ns, baud, bits)


def _settle_can(capture: Capture, given: ImportOptions, routes: Routes) -> None:
    """Find what the times of a log of a CAN bus count from, where it does not tell it in UTC."""
    told = can_log_time(capture.path, capture.kind)
    if told is FileTime.NONE:
        raise UserError(f"{capture.path}: its frames have no times; record with candump -L, or with -t a")
    sources = [capture.port.source] if capture.port is not None else routes.buses()
    starts = [given.start_ns[name] for name in (*sources, "") if name in given.start_ns]
    if told is not FileTime.UTC and not (capture.kind == "candump" and told is FileTime.LOCAL):
        capture.start_ns = starts[0] if starts else None
    if told is FileTime.SINCE_BEGIN and capture.start_ns is None:
        raise UserError(f"{capture.path}: its times count from its beginning, which it does not tell; give --start")
    if told is FileTime.LOCAL and capture.start_ns is None:
        capture.zone = given.zone
        if given.zone is None:
            capture.notes.append("its times are local times without a zone and were read as UTC; --zone names another")


def _settle_heads(capture: Capture, given: ImportOptions) -> None:
    """Find the time at which a file of Livox Viewer begins, where its packages have no UTC."""
    if tells_time(capture.path):
        return
    started = [given.start_ns[port.source] for port in capture.head_ports.values() if port.source in given.start_ns]
    capture.start_ns = started[0] if started else given.start_ns.get("")
    if capture.start_ns is None:
        raise UserError(f"{capture.path}: its head was not set to UTC, and the file has no other times; give --start")


# --- the folder of an export ----------------------------------------------------------------------------------------


def _of_export(routes: Routes, folder: Path) -> list[Capture]:
    """Return the files that an export's manifest names; for a folder of exports, those of all exports."""
    folders = [folder] if (folder / MANIFEST).exists() else sorted(path.parent for path in folder.glob(f"*/{MANIFEST}"))
    if not folders:
        raise UserError(f"{folder}: has no {MANIFEST}; give captures or the folder of an export")
    return [_exported(routes, one, name, entry) for one in folders for name, entry in _manifest(one / MANIFEST).items()]


def _manifest(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as stream:
            files = json.loads(stream.read(_MAX_MANIFEST_BYTES))["files"]
        if isinstance(files, dict) and all(isinstance(entry, dict) for entry in files.values()):
            return files
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError):
        pass
    raise UserError(f"{path}: is not a manifest of `swath export`; export the log again")


def _exported(routes: Routes, folder: Path, name: str, entry: dict[str, Any]) -> Capture:
    kind, source = entry.get("kind"), entry.get("source")
    try:
        path = safe_attachment_path(folder, name)
    except LogError as error:
        raise UserError(f"{folder / MANIFEST}: names {name!r}, which is not in its folder") from error
    if not os.path.isfile(path) or name.endswith(SUFFIX):
        raise UserError(f"{path}: does not exist, but {MANIFEST} names it; copy the whole folder of the export")
    if kind == "pcap":
        return Capture(path, "pcap")
    if kind not in _KIND_OF_PORT.values() or not isinstance(source, str):
        raise UserError(f"{folder / MANIFEST}: does not describe {name}; export the log again")
    port = _port(routes, source, str(path))
    if _KIND_OF_PORT[port.kind] != kind:
        raise UserError(f"{path}: is of kind {kind}, but {source} uses {port.kind} in this configuration")
    return Capture(path, kind, port)
