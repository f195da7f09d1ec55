"""`companion signing new` and the errors of `send`."""

from __future__ import annotations

import errno
import os
import shlex
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.vehicle.signing import SigningKeyError, read_key, write_new_key
from mavlink_sim.testing import free_port

pytestmark = pytest.mark.realtime


def test_new_key_is_private_random_and_never_replaced(tmp_path: Path) -> None:
    runner, files = CliRunner(), [tmp_path / "one", tmp_path / "other"]
    for file in files:
        done = runner.invoke(app, ["signing", "new", str(file)])
        assert done.exit_code == 0
        assert file.read_text().strip() not in done.output
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
    before = files[0].read_bytes()
    assert read_key(files[0]) != read_key(files[1])
    assert runner.invoke(app, ["signing", "new", str(files[0])]).exit_code == 2
    assert files[0].read_bytes() == before
    assert runner.invoke(app, ["signing", "new", str(tmp_path / "no" / "key")]).exit_code == 2


def test_name_of_a_key_with_a_space_can_be_copied(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["signing", "new", str(tmp_path / "mein schlüssel")])
    assert shlex.split(done.output)[-1] == str(tmp_path / "mein schlüssel")


def test_full_disk_leaves_no_part_of_a_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SigningKeyError, match="No space"):
        write_new_key(tmp_path / "key")
    assert list(tmp_path.iterdir()) == []


LISTENS = "import socket, sys; s = socket.socket(type=socket.SOCK_DGRAM); s.bind(('127.0.0.1', 0)); \
print(s.getsockname()[1], flush=True); sys.stdin.read()"


def test_send_names_the_program_that_has_the_link(tmp_path: Path) -> None:
    runner, key = CliRunner(), tmp_path / "key"
    runner.invoke(app, ["signing", "new", str(key)])
    command = [sys.executable, "-c", LISTENS]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        url = f"udpin://127.0.0.1:{int(program.stdout.readline())}"
        taken = runner.invoke(app, ["signing", "send", "--vehicle-url", url, "--key-file", str(key), "--yes"])
    assert taken.exit_code == 2
    assert f"kill {program.pid}" in taken.output


@pytest.mark.parametrize(
    "options", ["--key-file {key}", "--off --key-file {key} --yes", "--yes", "--key-file none --yes"]
)
def test_send_refuses_without_a_key_or_a_wire(tmp_path: Path, options: str) -> None:
    runner, key = CliRunner(), tmp_path / "key"
    runner.invoke(app, ["signing", "new", str(key)])
    words = options.format(key=key).split()
    url = f"udpin://127.0.0.1:{free_port()}"
    assert runner.invoke(app, ["signing", "send", "--vehicle-url", url, *words]).exit_code == 2
