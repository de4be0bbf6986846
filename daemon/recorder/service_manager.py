"""Reports the state of the service to systemd (sd_notify(3)), if it runs under systemd."""

from __future__ import annotations

import os
import socket

SEND_S = 0.5  # a manager that does not read must not block the watch loop


class ServiceManager:
    """The notify socket from the environment at start; every call is a no-op without one."""

    def __init__(self, environment: dict[str, str] | None = None) -> None:
        env = dict(os.environ) if environment is None else environment
        address = env.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        usec = env.get("WATCHDOG_USEC", "")
        for_us = env.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = int(usec) / 1e6 if usec.isdigit() and for_us else None

    def notify(self, **fields: str) -> None:
        """Send fields such as ``READY="1"`` or ``STATUS="recording"``."""
        if not self._address:
            return
        message = "\n".join(f"{key}={' '.join(value.split())}" for key, value in fields.items())
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
            sock.settimeout(SEND_S)
            try:
                sock.sendto(message.encode(), self._address)
            except OSError:
                return  # a missing manager must not stop the recording
