"""Text files that people write, as every reader of one gets them."""

from __future__ import annotations

import ast
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from vision.file_kinds import open_file
from vision.text_file import read_text

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_byte_order_mark_is_no_part_of_the_text(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "names.txt").write_text("Fußgänger\n", encoding)
    assert read_text(tmp_path / "names.txt") == "Fußgänger\n"


def test_text_files_are_read_in_one_place() -> None:
    """`read_text("utf-8")` and `read_bytes().decode("utf-8")` elsewhere would keep the byte order mark."""
    found = []
    for package in ("companion", "vision", "mavlink_sim"):
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            if "decode" not in text and "read_text" not in text:
                continue
            for node in ast.walk(ast.parse(text)):
                if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                    continue
                if node.func.attr not in ("decode", "read_text"):
                    continue
                words = ast.unparse(node)
                decodes = node.func.attr == "decode" and ".read_bytes()" in words
                reads = node.func.attr == "read_text" and "encoding='utf-8'" in words
                if (decodes or reads) and "resources.files" not in words:
                    found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    # A device tree is the kernel's.
    assert [place for place in found if "stored_choice" not in place] == []


def test_pipe_without_a_writer_is_an_error_and_one_with_a_writer_is_read(tmp_path: Path) -> None:
    os.mkfifo(path := tmp_path / "settings.toml")
    with pytest.raises(OSError, match="pipe"):
        read_text(path)
    with pytest.raises(OSError, match="pipe"):
        open_file(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    writer = os.open(path, os.O_WRONLY)
    with ThreadPoolExecutor() as pool:
        read = pool.submit(read_text, path)
        os.write(writer, "\ufeffa = 1\n".encode())
        os.close(writer)
        assert read.result(timeout=10) == "a = 1\n"
    os.close(reader)
