"""Runs the console: address, tokens, certificate and pairing, the server and the thread that watches."""

from __future__ import annotations

import asyncio
import datetime as dt
import hashlib
import io
import ipaddress
import os
import socket
import ssl
from pathlib import Path

import psutil
import segno
import uvicorn
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from uvicorn.protocols.http.h11_impl import H11Protocol

from swath.daemon.config.listen import Place
from swath.daemon.config.tables import ConsoleConfig
from swath.daemon.console.access import OPERATOR, VIEWER, Access, read_tokens
from swath.daemon.console.app import make_app
from swath.daemon.console.background import Background
from swath.daemon.console.rasters import Raster
from swath.daemon.console.watch import Watch
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.recorder.service_manager import ServiceManager

CONNECTIONS = 300  # at once; more are refused
SILENT_S = 10.0  # a connection that has not asked by then is closed
KEY, CERTIFICATE = "key.pem", "certificate.pem"
CERTIFICATE_DAYS = 3650
SERVICE_STATE = Path("/var/lib/swath-console")  # of swath-console.service
_LOCAL = ("localhost", "127.0.0.1", "::1", "0.0.0.0", "::")


def state_folder() -> Path:
    """Return the folder for tokens and certificate: the service's for its user, else the user's own."""
    of_unit = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if of_unit:
        return Path(of_unit)
    if SERVICE_STATE.is_dir() and SERVICE_STATE.stat().st_uid == os.geteuid():
        return SERVICE_STATE
    base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local/state")
    return Path(base) / "swath-console"


def names_of(place: Place, config: ConsoleConfig) -> list[str]:
    """Return the names and addresses by which the console may be called."""
    names = ["localhost", "127.0.0.1", "::1", place.address, *config.names]
    if not place.is_local:
        names += [socket.gethostname(), f"{socket.gethostname()}.local", *_own_addresses()]
    return sorted(set(names))


def _own_addresses() -> list[str]:
    families = (socket.AF_INET, socket.AF_INET6)
    found = [one.address for entries in psutil.net_if_addrs().values() for one in entries if one.family in families]
    return [address.partition("%")[0] for address in found]


def certificate(folder: Path, names: list[str]) -> tuple[Path, Path]:
    """Return key and certificate of this console, made at the first time; the page's reader has to accept it once.

    Raises:
        UserError: a file cannot be written.
    """
    key_path, path = folder / KEY, folder / CERTIFICATE
    if not (key_path.exists() and path.exists()):
        try:
            _make_certificate(key_path, path, names)
        except OSError as error:
            text = f"{error.filename}: {error.strerror}; the console keeps its certificate there"
            raise UserError(text, ExitCode.IO) from error
    return key_path, path


def _make_certificate(key_path: Path, path: Path, names: list[str]) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "Swath console")])
    now = dt.datetime.now(dt.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - dt.timedelta(days=2))  # an aircraft's clock may be behind
        .not_valid_after(now + dt.timedelta(days=CERTIFICATE_DAYS))
        .add_extension(x509.SubjectAlternativeName([_alternative(name) for name in names]), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    with os.fdopen(os.open(key_path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        file.write(private)
    path.write_bytes(made.public_bytes(serialization.Encoding.PEM))


def _alternative(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def pairing_text(place: Place, config: ConsoleConfig, *, viewer: bool) -> str:
    """Return address, QR code and the certificate's fingerprint, which the tablet's browser shows at its warning.

    Raises:
        UserError: the console listens on this computer only, or the tokens cannot be read.
    """
    if place.is_local:
        raise UserError(
            f"the console listens at {place.host}:{place.port} only, where no token is needed; for a tablet set "
            "[console] listen to an address of this computer, such as 0.0.0.0:8470",
            ExitCode.USAGE,
        )
    folder, names = state_folder(), names_of(place, config)
    role = VIEWER if viewer else OPERATOR
    token = read_tokens(folder)[role]
    _, path = certificate(folder, names)
    digest = hashlib.sha256(ssl.PEM_cert_to_DER_cert(path.read_text())).hexdigest().upper()
    fingerprint = ":".join(digest[i : i + 2] for i in range(0, len(digest), 2))
    host = next((name for name in (*config.names, place.address, *names) if name not in _LOCAL), place.address)
    address = f"https://{f'[{host}]' if ':' in host else host}:{place.port}/login#{token}"
    code = io.StringIO()
    segno.make(address, error="m").terminal(out=code, compact=True)
    return f"{address}\n{code.getvalue()}\nfor the {role}; SHA-256 of the certificate:\n{fingerprint}"


class _Protocol(H11Protocol):
    """HTTP of a client that has to ask within `SILENT_S`; uvicorn itself waits for ever for the first request."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        super().connection_made(transport)
        asyncio.get_running_loop().call_later(SILENT_S, self._close_if_silent)

    def _close_if_silent(self) -> None:
        if self.cycle is None and not self.transport.is_closing():
            self.transport.close()


def serve(
    directory: Path,
    live: Path,
    config: ConsoleConfig,
    place: Place,
    *,
    asks: bool = True,
    background: Raster | None = None,
) -> None:
    """Serve until a signal comes; with ``asks`` False, no recorder is asked for anything.

    Raises:
        UserError: the port is in use, or tokens or certificate cannot be kept.
    """
    manager = ServiceManager()
    names = names_of(place, config)
    tokens: dict[str, str] = {}
    key: Path | None = None
    chain: Path | None = None
    if not place.is_local:
        folder = state_folder()
        tokens = read_tokens(folder)
        key, chain = certificate(folder, names)
    watch = Watch(directory, live)
    if background is not None:
        watch.background = Background(background, lambda: watch.painter.placement)
    app, feed = make_app(watch, Access(tokens), directory if asks else None, config, names, secure=not place.is_local)
    sock = _bound(place)
    settings = uvicorn.Config(
        app,
        http=_Protocol,
        ws="none",
        log_level="critical",
        access_log=False,
        server_header=False,
        limit_concurrency=CONNECTIONS,
        timeout_keep_alive=15,
        timeout_graceful_shutdown=2,
        h11_max_incomplete_event_size=16_384,
        backlog=128,
        ssl_keyfile=key,
        ssl_certfile=chain,
    )
    watch.tell = feed.tell
    watch.read()
    watch.start()
    manager.notify(READY="1", STATUS=f"console at port {place.port}")
    try:
        uvicorn.Server(settings).run(sockets=[sock])
    finally:
        watch.close()
        sock.close()
        if background is not None:
            background.close()


def _bound(place: Place) -> socket.socket:
    family = socket.AF_INET6 if ":" in place.address else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((place.address, place.port))
    except OSError as error:
        sock.close()
        raise UserError(
            f"{place.host}:{place.port}: {error.strerror}; another console may listen there: --listen ADDRESS:PORT",
            ExitCode.IO,
        ) from error
    return sock
