"""The file system in memory behaves as a real one does: the same calls on both, the same outcome."""

import os
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.services.file_transfer import FileSystem

paths = st.lists(st.sampled_from(["a", "b", "c"]), min_size=1, max_size=3).map("/".join)
calls = st.one_of(
    st.tuples(st.just("create"), paths),
    st.tuples(st.just("write"), paths),
    st.tuples(st.just("truncate"), paths),
    st.tuples(st.just("remove"), paths),
    st.tuples(st.just("make directory"), paths),
    st.tuples(st.just("remove directory"), paths),
    st.tuples(st.just("rename"), paths, paths),
    st.tuples(st.just("list"), paths),
)


def in_memory(files: FileSystem, name: str, *arguments: str) -> object:
    path = arguments[0]
    if name == "create":
        files.create(path, truncate=True)
    elif name == "write":
        files.write(files.create(path, truncate=False), 2, b"xyz")
    elif name == "truncate":
        files.truncate(path, 3)
    elif name == "remove":
        files.remove(path)
    elif name == "make directory":
        files.make_directory(path)
    elif name == "remove directory":
        files.remove_directory(path)
    elif name == "rename":
        files.rename(*arguments)
    else:
        return list(files.list(path))
    return None


def on_disk(root: Path, name: str, *arguments: str) -> object:
    path = root / arguments[0]
    if name == "create":
        path.write_bytes(b"")
    elif name == "write":
        descriptor = os.open(path, os.O_CREAT | os.O_WRONLY)
        os.pwrite(descriptor, b"xyz", 2)
        os.close(descriptor)
    elif name == "truncate":
        os.truncate(path, 3)
    elif name == "remove":
        os.unlink(path)
    elif name == "make directory":
        path.mkdir()
    elif name == "remove directory":
        path.rmdir()
    elif name == "rename":
        os.rename(path, root / arguments[1])
    else:
        return sorted(
            (child.name, None if child.is_dir() else child.stat().st_size) for child in path.iterdir()
        )
    return None


def outcome(call: Callable[[], object]) -> object:
    try:
        return call()
    except OSError as error:
        return error.errno


@settings(max_examples=150, deadline=None)
@given(st.lists(calls, max_size=25))
def test_calls_match_a_real_file_system(script: list[tuple[str, ...]]) -> None:
    files = FileSystem()
    with tempfile.TemporaryDirectory() as folder:
        for step in script:
            here = outcome(partial(in_memory, files, *step))
            assert here == outcome(partial(on_disk, Path(folder), *step)), step


def test_provided_file_is_generated_at_each_read() -> None:
    files = FileSystem()
    contents = iter([b"one", b"two"])
    files.provide("etc/now", lambda: next(contents))
    assert [files.read("etc/now"), files.read("/etc/now")] == [b"one", b"two"]


@pytest.mark.parametrize("path", ["etc/now", "etc", "/", ""])
def test_provided_files_are_read_only(path: str) -> None:
    files = FileSystem()
    files.provide("etc/now", lambda: b"")
    for change in (
        lambda: files.create(path, truncate=True),
        lambda: files.remove(path),
        lambda: files.remove_directory(path),
        lambda: files.rename(path, "elsewhere"),
        lambda: files.truncate(path, 0),
    ):
        with pytest.raises(OSError, match="Read-only"):
            change()


def test_entries_are_limited() -> None:
    files = FileSystem()

    def fill() -> None:
        for number in range(3000):
            files.make_directory(f"folder-{number}")

    with pytest.raises(OSError, match="No space"):
        fill()
