"""Notifies systemd of the service's state: sd_notify(3), a datagram to the socket in NOTIFY_SOCKET.

The watchdog is triggered by the guidance loop itself, never by a separate timer: when that loop hangs,
systemd restarts the service; the autopilot has received no setpoints since.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Mapping

logger = logging.getLogger(__name__)


class SystemdNotifier:
    """Does nothing where NOTIFY_SOCKET is not set (not started by systemd with Type=notify)."""

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        variables = os.environ if environment is None else environment
        path = variables.get("NOTIFY_SOCKET", "")
        # A leading @ means the abstract namespace (unix(7)).
        self._address = "\0" + path[1:] if path.startswith("@") else path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if path else None
        if self._socket is not None:
            self._socket.setblocking(False)

    def ready(self, status: str) -> None:
        """Report that the service is up."""
        self._send(f"READY=1\nSTATUS={status}")

    def alive(self) -> None:
        """Trigger the watchdog (WatchdogSec=)."""
        self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """Set the line of `systemctl status`."""
        self._send(f"STATUS={text}")

    def stopping(self) -> None:
        """Report that the service is shutting down."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, message: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError as error:
            logger.warning("systemd notification %r not sent: %s", message.split("=")[0], error)
