"""sd_notify's protocol, read from a real datagram socket."""

from __future__ import annotations

import socket
from pathlib import Path

from companion.service.systemd_notify import SystemdNotifier


def test_systemd_hears_that_the_service_is_ready_alive_and_stopping(tmp_path: Path) -> None:
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


def test_an_address_with_an_at_sign_is_in_the_abstract_namespace() -> None:
    name = f"companion-test-{id(object())}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(f"\0{name}")
        notifier = SystemdNotifier({"NOTIFY_SOCKET": f"@{name}"})
        notifier.alive()
        notifier.close()
        assert systemd.recv(100) == b"WATCHDOG=1"


def test_without_systemd_nothing_is_sent_and_nothing_fails() -> None:
    notifier = SystemdNotifier({})
    notifier.ready("x")
    notifier.alive()
    notifier.close()


def test_a_systemd_that_has_gone_is_a_warning_not_a_crash(tmp_path: Path, caplog) -> None:  # type: ignore[no-untyped-def]
    notifier = SystemdNotifier({"NOTIFY_SOCKET": str(tmp_path / "nobody")})
    notifier.alive()
    notifier.close()
    assert "systemd did not take 'WATCHDOG'" in caplog.text
