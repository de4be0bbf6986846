"""Exports a log as files that the tools of its devices read: serial streams, candump, pcap, PPS text.

Every source is written in the log's own order. Information that a format cannot hold goes into a sidecar
(`swath.daemon.exchange.sidecar`), so that `swath import` restores the same units from it.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.exchange.export_files import CandumpFile, NativeFile, PcapFile, PpsFile, SerialFile
from swath.daemon.log.durable import sync_tree, try_sync_directory
from swath.daemon.log.format import LogError, safe_attachment_path, source_of_topic
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.parsers import stored_config
from swath.daemon.log.reader import Session
from swath.daemon.system import held_interrupts
from swath.daemon.written import make_folder, note_written

MANIFEST = "swath-export.json"
CONFIG_FOLDER = "config"
_UNFINISHED = ".part"
_EARLIER = ".earlier"
_MOST_NAME_BYTES = 200  # names derived from it are longer, and file systems accept at most 255
_MOST_PLACE = 500  # characters of a name with its folders, which are created one inside the other
_NO_PLACE = (errno.ENAMETOOLONG, errno.ENOTDIR, errno.EEXIST, errno.EISDIR)  # a foreign log's name, or a collision


@dataclass(slots=True)
class ExportReport:
    """The files that an export wrote.

    Attributes:
        folder: the export's folder.
        files: the manifest's entry of each file, by name.
        units: number by source.
        notes: remarks for the reader, one line each.
    """

    folder: Path
    files: dict[str, dict[str, Any]] = field(default_factory=dict)
    units: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    def plain(self) -> dict[str, Any]:
        """Return files and units as plain values for ``--json``."""
        return {"files": self.files, "units": dict(self.units)}

    def lines(self) -> list[str]:
        """Return a line for each file."""
        return [f"{name}: {entry['kind']}, {entry['units']} units" for name, entry in self.files.items()]


def export_session(session: Session, directory: Path, *, overwrite: bool = False) -> ExportReport:
    """Write a session into ``directory/<session_id>``; the folder appears when it is complete.

    Args:
        session: as `open_logs` gives it; read once, a chunk at a time.
        directory: created if necessary.
        overwrite: replace an export of the same session.

    Raises:
        LogError: the log's name cannot be the name of a folder.
        UserError: the folder exists already.
        OSError: it cannot be written; nothing is left of it.
    """
    target = safe_attachment_path(directory, session.session_id)
    if target.parent != directory or len(os.fsencode(target.name)) > _MOST_NAME_BYTES:
        raise LogError(f"session {session.session_id[:60]!r}: cannot be a folder name; this session was not exported")
    unfinished = target.with_name(target.name + _UNFINISHED)
    earlier = target.with_name(target.name + _EARLIER)
    for path in (unfinished, earlier):
        if os.path.lexists(path):
            raise UserError(f"{path}: is left of a killed export; remove it or choose another folder", ExitCode.IO)
    if os.path.lexists(target) and not overwrite:
        raise UserError(f"{target}: already exists; choose another folder or use --overwrite", ExitCode.USAGE)
    if os.path.lexists(target) and not (target / MANIFEST).is_file():
        raise UserError(f"{target}: is not an export; remove it or choose another folder", ExitCode.USAGE)
    make_folder(directory)
    unfinished.mkdir()
    try:
        report = _Export(session, unfinished).run()
        sync_tree(unfinished)
        with held_interrupts():
            if target.exists():
                target.rename(earlier)
            unfinished.rename(target)
            shutil.rmtree(earlier, ignore_errors=True)
            note_written(target)
    except BaseException:
        shutil.rmtree(unfinished, ignore_errors=True)
        raise
    try_sync_directory(directory)
    report.folder = target
    return report


class _Export:
    """Exports one session into a folder."""

    def __init__(self, session: Session, folder: Path) -> None:
        self._session = session
        self._folder = folder
        self._report = ExportReport(folder)
        self._files: dict[str, NativeFile] = {}
        self._of_source: dict[tuple[str, str], NativeFile] = {}

    def run(self) -> ExportReport:
        """Write all files and return the report."""
        self._write_configuration()
        strange: Counter[str] = Counter()
        try:
            for batch in self._session.batches():
                source = source_of_topic(batch.channel.topic)
                file = None if source is None else self._file(source, batch)
                if file is not None and source is not None:
                    file.add(source, batch)
                    self._report.units[source] += len(batch.units)
                elif source is not None:
                    strange[f"{batch.channel.topic} ({batch.channel.message_encoding})"] += len(batch.units)
        finally:
            for file in self._files.values():
                file.close()
        self._report.notes += [
            f"{topic}: {count} messages of an unknown kind, not exported" for topic, count in strange.items()
        ]
        self._report.notes += [f"{name}: {note}" for name, file in self._files.items() for note in file.notes()]
        self._write_manifest()
        return self._report

    def _file(self, source: str, batch: LogBatch) -> NativeFile | None:
        encoding = batch.channel.message_encoding
        file = self._of_source.get((source, encoding))
        if file is None:
            kinds: dict[str, type[NativeFile]] = {
                "x-swath-serial": SerialFile,
                "x-swath-can": CandumpFile,
                "x-swath-udp": PcapFile,
            }
            kind = PpsFile if source.startswith("pps/") else kinds.get(encoding)
            if kind is None:
                return None
            # the viewer of a head's maker expects both ports in one file, as one tcpdump captures them
            of_head = source.removesuffix("/aux") if kind is PcapFile else source
            file = self._of_source.get((of_head, encoding)) or self._new_file(kind, of_head, batch)
            self._of_source[of_head, encoding] = self._of_source[source, encoding] = file
        return file

    def _new_file(self, kind: type[NativeFile], source: str, batch: LogBatch) -> NativeFile:
        stem = re.sub(r"[^A-Za-z0-9_-]+", "-", source)
        suffix = kind.suffix_for(batch.channel)
        name, number = stem + suffix, 2
        while name in self._files:
            name, number = f"{stem}-{number}{suffix}", number + 1
        file = self._files[name] = kind(self._folder / name)
        self._report.files[name] = {"kind": kind.kind, "source": None if kind is PcapFile else source}
        return file

    def _write_manifest(self) -> None:
        for name, file in self._files.items():
            self._report.files[name]["units"] = file.units
        manifest = {
            "swath_export": 1,
            "session_id": self._session.session_id,
            "software": self._session.info.software,
            "realtime_ns": self._session.info.realtime_ns,
            "monotonic_ns": self._session.info.monotonic_ns,
            "files": self._report.files,
        }
        (self._folder / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n")

    def _write_configuration(self) -> None:
        """Write the configuration, and each of its files also under the path that it uses, if that is below its own
        folder.
        """
        attachments = self._session.attachments()
        places = {name: [name] for name in attachments}
        try:
            config = stored_config(attachments)
            named = config.attachment_names() if config is not None else []
        except LogError as error:
            self._report.notes.append(str(error))
            named = []
        for name, place in named:
            places.setdefault(name, []).append(place)
        for name, data in attachments.items():
            written = [self._write_attachment(place, data) for place in reversed(places[name])]
            if not all(written[:-1]):
                self._report.notes.append(f"config.toml names another path for {name}; change it before `swath import`")
            if not written[-1]:
                self._report.notes.append(
                    f"attachment {name[:60]!r} is left out: its name is not a valid file name here"
                )

    def _write_attachment(self, place: str, data: bytes) -> bool:
        """Write an attachment, below the folder only, and return whether the file exists now."""
        try:
            path = safe_attachment_path(self._folder / CONFIG_FOLDER, place)
        except LogError:
            return False
        if len(place) > _MOST_PLACE:
            return False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.exists():
                path.write_bytes(data)
        except OSError as error:
            if error.errno not in _NO_PLACE:
                raise
            return False
        return path.is_file()
