"""A broker of MQTT that nobody here wrote, on a port of this computer, which can be stopped and killed."""

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.programs import MOSQUITTO


@contextmanager
def broker(port: int, folder: Path, more: str = "") -> Iterator[subprocess.Popen[bytes]]:
    """Run mosquitto meanwhile. `more`: lines of its configuration, instead of access for everybody."""
    assert MOSQUITTO is not None
    file = folder / f"mosquitto{port}.conf"
    # Started by root it would become another user, who cannot read the test's files.
    file.write_text(
        f"user root\nlistener {port} 127.0.0.1\npersistence false\n{more or 'allow_anonymous true'}\n"
    )
    process = subprocess.Popen(
        [MOSQUITTO, "-c", str(file)], stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT
    )
    try:
        _wait_until_it_listens(port)
        yield process
    finally:
        process.kill()
        process.wait()


def _wait_until_it_listens(port: int) -> None:
    deadline_s = time.monotonic() + 10.0
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
            return
        except ConnectionRefusedError:
            if time.monotonic() > deadline_s:
                raise
        time.sleep(0.02)
