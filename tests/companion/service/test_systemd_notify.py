"""The sd_notify protocol on a real datagram socket."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from companion.service.systemd_notify import SystemdNotifier

pytestmark = pytest.mark.realtime


def test_notifications_are_sent_to_systemd(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(path))
        notifier = SystemdNotifier({"NOTIFY_SOCKET": str(path)})
        notifier.ready("flying")
        notifier.alive()
        notifier.stopping()
        notifier.close()
        assert [systemd.recv(100) for _ in range(3)] == [
            b"READY=1\nSTATUS=flying",
            b"WATCHDOG=1",
            b"STOPPING=1",
        ]


def test_at_sign_is_the_abstract_namespace() -> None:
    name = f"companion-test-{id(object())}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(f"\0{name}")
        notifier = SystemdNotifier({"NOTIFY_SOCKET": f"@{name}"})
        notifier.alive()
        notifier.close()
        assert systemd.recv(100) == b"WATCHDOG=1"


def test_notifier_without_systemd_does_nothing() -> None:
    notifier = SystemdNotifier({})
    notifier.ready("x")
    notifier.alive()
    notifier.close()


def test_lost_systemd_is_a_warning(tmp_path: Path, caplog) -> None:  # type: ignore[no-untyped-def]
    notifier = SystemdNotifier({"NOTIFY_SOCKET": str(tmp_path / "nobody")})
    notifier.alive()
    notifier.close()
    assert "'WATCHDOG'" in caplog.text
