"""A settings file is changed line by line, and nothing that was in it is lost."""

from __future__ import annotations

import errno
import os
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest

from companion.settings.layers import SYSTEM_VARIABLE, user_file
from companion.settings.reading import ConfigurationError
from companion.setup import settings_file
from companion.setup.settings_file import MARK, Change, MergeError, difference, merged, write
from companion.setup.target import check_text, read_target

URL = Change("vehicle.url", "serial:///dev/ttyAMA0:57600", "received")
CAMERA = Change("source.uri", "csi://0", "imx708")
FILES = (
    "",
    "# of mine\n",
    "[vehicle]\n",
    "[vehicle]\nname = 'a1'  # mine\n",
    "[ vehicle ] # link\nurl='udpin://127.0.0.1:14600' # old\nname = 'a'",
    "[detector]\nimage_size = 320\n\n[vehicle]\n# kept\n\n[source]\nwidth = 640\nheight = 480\n",
    '[log]\nlevel = "debug"',
)


@pytest.mark.parametrize("text", FILES)
def test_merged_file_has_the_changes_and_all_else(text: str) -> None:
    after = merged(text, [URL, CAMERA])
    values = tomllib.loads(after)
    expected: dict[str, Any] = tomllib.loads(text)
    expected.setdefault("vehicle", {})["url"] = URL.value
    expected.setdefault("source", {})["uri"] = CAMERA.value
    assert values == expected
    comments = [line for line in text.splitlines() if line.startswith("#")]
    assert all(line in after.splitlines() for line in comments)
    assert merged(after, [URL, CAMERA]) == after


def test_comment_of_an_earlier_run_is_replaced() -> None:
    once = merged("", [URL])
    twice = merged(once, [Change("vehicle.url", "tcp://127.0.0.1:5760", "another")])
    assert twice.count(MARK) == once.count(MARK)
    assert "received" not in twice


def test_equal_value_changes_nothing() -> None:
    text = '[vehicle]\nurl="serial:///dev/ttyAMA0:57600"\n'
    assert merged(text, [URL]) == text
    assert merged("", []) == ""


@pytest.mark.parametrize(
    "text",
    [
        'vehicle = { url = "udpin://127.0.0.1:1" }\n',
        'vehicle.url = "udpin://127.0.0.1:1"\n',
        'note = """\n[vehicle]\n"""\n',
        '[vehicle]\n"url" = "udpin://127.0.0.1:1"\n',
        '[vehicle]\nurl = """\nx"""\n',
    ],
)
def test_file_of_another_form_is_refused_and_not_damaged(text: str) -> None:
    with pytest.raises(MergeError, match=r"vehicle\.url"):
        merged(text, [URL])


def test_multi_line_value_is_changed_only_if_the_rest_stays() -> None:
    text = '[detector]\nclasses = [\n  "person",\n]\nimage_size = 320\n'
    after = merged(text, [Change("detector.runtime", "openvino", "measured")])
    assert tomllib.loads(after)["detector"] == {
        "classes": ["person"],
        "image_size": 320,
        "runtime": "openvino",
    }


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_no_one_else_reads_a_private_file_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, umask: int
) -> None:
    modes: list[int] = []
    create = os.open

    def opened(path: str | Path, flags: int, mode: int = 0o777) -> int:
        modes.append(mode)
        return create(path, flags, mode)

    path = tmp_path / "companion.toml"
    path.write_text('[source]\nuri = "rtsp://anna:geheim@camera/1"\n')
    path.chmod(0o640)
    monkeypatch.setattr(os, "open", opened)
    before = os.umask(umask)
    try:
        kept = write(path, "second\n", now_s=1e9)
    finally:
        os.umask(before)
    assert modes == [0o600, 0o600]
    assert kept is not None
    assert [each.stat().st_mode & 0o777 for each in (path, kept)] == [0o640, 0o640]


def test_new_file_of_root_is_read_by_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    before = os.umask(0o077)
    try:
        write(tmp_path / "companion.toml", "new\n")
    finally:
        os.umask(before)
    assert (tmp_path / "companion.toml").stat().st_mode & 0o777 == 0o644


def test_copy_is_not_written_through_a_link(tmp_path: Path) -> None:
    (path := tmp_path / "companion.toml").write_text("first\n")
    stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(1e9))
    (tmp_path / f"companion.toml.{stamp}").symlink_to(tmp_path / "elsewhere")
    write(path, "second\n", now_s=1e9)
    assert not (tmp_path / "elsewhere").exists()


def test_full_disk_leaves_the_former_file_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (path := tmp_path / "companion.toml").write_text("first\n")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write(path, "second\n")
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [("companion.toml", "first\n")]


def test_copy_of_another_program_is_not_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (path := tmp_path / "companion.toml").write_text("first\n")
    theirs = tmp_path / "companion.toml.copy"
    theirs.write_text("theirs\n")
    monkeypatch.setattr(settings_file, "_free_name", lambda *_: theirs)
    with pytest.raises(FileExistsError):
        write(path, "second\n")
    assert {each.name: each.read_text() for each in tmp_path.iterdir()} == {
        "companion.toml": "first\n",
        "companion.toml.copy": "theirs\n",
    }


def test_ctrl_c_after_the_change_leaves_the_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (path := tmp_path / "companion.toml").write_text("first\n")
    replace = os.replace

    def interrupted(source: Path, target: Path) -> None:
        replace(source, target)
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(path, "second\n")
    assert path.read_text() == "second\n"
    (copy,) = [each for each in tmp_path.iterdir() if each != path]
    assert copy.read_text() == "first\n"


def test_former_file_is_kept_with_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "companion.toml"
    path.write_text("first\n")
    path.chmod(0o600)
    copies = [write(path, text, now_s=1e9) for text in ("second\n", "third\n")]
    assert [copy and copy.read_text() for copy in copies] == ["first\n", "second\n"]
    assert path.read_text() == "third\n"
    assert path.stat().st_mode & 0o777 == 0o600
    assert sorted(each.suffix for each in tmp_path.iterdir()) == sorted(
        [".toml", *(copy.suffix for copy in copies if copy)]
    )


def test_link_to_a_file_stays_a_link(tmp_path: Path) -> None:
    (real := tmp_path / "real.toml").write_text("first\n")
    (link := tmp_path / "link.toml").symlink_to(real)
    write(link, "second\n")
    assert link.is_symlink()
    assert real.read_text() == "second\n"


def test_new_file_is_written_with_its_folders(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "companion.toml"
    assert write(path, "text\n") is None
    assert [each.name for each in path.parent.iterdir()] == ["companion.toml"]


def test_difference_is_of_changed_lines() -> None:
    lines = list(difference("a\nb\n", "a\nc\n", Path("x.toml")))
    assert "-b" in lines
    assert "+c" in lines


def test_default_is_written_only_over_another_value(tmp_path: Path) -> None:
    default = "udpin://127.0.0.1:14540"
    path = tmp_path / "companion.toml"
    assert read_target(path).changes("vehicle.url", default, "received") == []
    path.write_text('[vehicle]\nurl = "udpin://127.0.0.1:14600"\n')
    (change,) = read_target(path).changes("vehicle.url", default, "received")
    assert change.value == default


def test_value_of_the_systems_file_is_overridden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (system := tmp_path / "system.toml").write_text('[source]\nuri = "csi://0"\n')
    monkeypatch.setenv(SYSTEM_VARIABLE, str(system))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (change,) = read_target(user_file()).changes("source.uri", "/dev/video0", "seen")
    assert change.value == "/dev/video0"


def test_file_with_mistakes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "companion.toml"
    path.write_text("[detector]\nconfidence = 3\n")
    with pytest.raises(ConfigurationError, match=r"detector\.confidence"):
        read_target(path)
    with pytest.raises(ConfigurationError):
        check_text(path, "[tracker]\nlost_s = 1.0\n")
