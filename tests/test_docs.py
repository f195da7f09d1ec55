"""The commands in the documents are valid, and their links and file names exist."""

from __future__ import annotations

import functools
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from companion.cli import app as companion_app
from companion.guidance import grammar
from companion.guidance.command import COMMANDS
from companion.settings.fields import fields_of_sections
from companion.settings.former import REMOVED, RENAMED
from companion.settings.reading import flags
from mavlink_sim.cli.main import app as simulator_app
from tools import check_table

ROOT = Path(__file__).parent.parent
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "SECURITY.md",
    *sorted((ROOT / "docs").glob("**/*.md")),
    *sorted((ROOT / "systemd").glob("*.service")),
]
command_of = functools.cache(typer.main.get_command)
APPS = {"companion": companion_app, "mavlink-sim": simulator_app}


def shell_lines(document: Path) -> Iterator[str]:
    for block in re.findall(r"^```sh\n(.*?)^```", document.read_text(), re.MULTILINE | re.DOTALL):
        yield from (line for line in block.splitlines() if line.strip() and not line.lstrip().startswith("#"))


def commands(document: Path) -> Iterator[list[str]]:
    """Each command in the document's shell blocks and inline `code`, split into words."""
    for line in shell_lines(document):
        for part in line.split(" | "):
            words = shlex.split(part, comments=True)
            yield words[: words.index(">")] if ">" in words else words
    for code in re.findall(r"`([^`\n]+)`", document.read_text()):
        if code.startswith(("companion ", "mavlink-sim ")):
            yield shlex.split(code)


COMMAND_LINES = [
    pytest.param(words, id=f"{document.name}: {' '.join(words)[:60]}")
    for document in DOCUMENTS
    for words in commands(document)
    if words and words[0] in APPS and not any("…" in word or "|" in word for word in words)
]


@pytest.mark.parametrize("words", COMMAND_LINES)
def test_every_command_in_documents_is_valid(words: list[str]) -> None:
    command = command_of(APPS[words[0]])
    context = command.make_context(words[0], words[1:], resilient_parsing=False)
    # A group passes the rest to its command, which must accept all of it.
    while hasattr(command, "resolve_command"):
        rest = [*context._protected_args, *context.args]
        if getattr(command, "invoke_without_command", False):
            if not rest:
                return
            # Its own options are not for its commands, which refuse them when they run.
            assert rest == words[1:], f"{' '.join(words)}: options before {rest[0]}"
        assert rest, f"{' '.join(words)}: no command"
        name, command, rest = command.resolve_command(context, rest)
        assert command is not None, f"{' '.join(words)}: no command {name!r}"
        context = command.make_context(name, rest, parent=context)


def test_every_make_target_in_documents_exists() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for document in DOCUMENTS:
        for words in commands(document):
            if words and words[0] == "make":
                assert words[1] in targets, f"{document.name}: make {words[1]}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_link_in_documents_has_a_target(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)", document.read_text()):
        if "://" not in target:
            assert (document.parent / target).exists(), f"{document.name} links to {target}"


def test_every_file_in_architecture_exists() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    cells = re.findall(r"^\| (?:\d+ \| )?(`[^|]+`) \|", text, re.MULTILINE)
    names = re.findall(r"`([^`]+)`", " ".join(cells))
    assert len(names) > 100
    roots = ("", "vision", "mavlink_sim", "companion", "companion/guidance")
    for name in names:
        assert any((ROOT / root / name).exists() for root in roots), f"docs/architecture.md: {name}"


def test_table_of_checks_is_up_to_date() -> None:
    page = check_table.FILE.read_text()
    assert check_table.with_table(page) == page, "python -m tools.check_table"


def test_flight_command_table_is_complete() -> None:
    rows = re.findall(r"^\| (`.*?) \|", (ROOT / "docs" / "flight.md").read_text(), re.MULTILINE)
    commands = [grammar.parse(text) for row in rows for text in re.findall(r"`([^`]+)`", row)]
    assert {type(command) for command in commands} == set(COMMANDS.values())


def settings_in_blocks(text: str) -> Iterator[str]:
    """The keys of the blocks that are a settings file, without the names of cameras."""
    for block in re.findall(r"^```toml\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        tables = tomllib.loads(block)
        if tables.keys() <= {*fields_of_sections(), "cameras"}:
            for sections in (tables, *tables.pop("cameras", {}).values()):
                yield from (f"{name}.{key}" for name, table in sections.items() for key in table)


@pytest.mark.parametrize("document", DOCUMENTS, ids=str)
def test_settings_in_documents_exist(document: Path) -> None:
    text = document.read_text()
    if document.name != "scenes.md":  # its blocks are files of scenes
        assert set(settings_in_blocks(text)) <= {flag.key for flag in flags()}
    named = set(re.findall(r"\b[a-z]+\.[a-z_]+\b", text))
    assert not named & (RENAMED.keys() | REMOVED.keys())


def test_every_parameter_that_the_sitl_tests_set_is_documented() -> None:
    sources = [path.read_text() for path in (ROOT / "tests" / "sitl").glob("*.py")]
    names = {name for text in sources for name in re.findall(r'"([A-Z0-9]+_[A-Z0-9_]+)": ', text)}
    assert len(names) > 10
    page = (ROOT / "docs" / "how-to" / "sitl.md").read_text()
    (listed,) = re.findall(r"They set parameters, .*?\sof ArduPilot\.", page, re.DOTALL)
    assert not {name for name in names if f"`{name}`" not in listed}


def test_every_promise_of_safety_names_a_test_that_exists() -> None:
    safety = (ROOT / "docs" / "safety.md").read_text()
    promises = safety.partition("## Which test holds which promise")[2].partition("\n## ")[0]
    rows = [line for line in promises.splitlines() if line.startswith("| ") and "`" in line]
    assert len(rows) > 20
    for row in rows:
        named = re.findall(r"`([\w/]+\.py)::(test_\w+)`", row)
        assert named, row
        for path, test in named:
            files = [folder / path for folder in (ROOT / "tests", ROOT / "tests" / "companion")]
            texts = [file.read_text() for file in files if file.exists()]
            assert any(f"def {test}(" in text for text in texts), (path, test)


def test_index_lists_every_document() -> None:
    index = (ROOT / "docs" / "README.md").read_text()
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").glob("**/*.md")}
    assert not {page for page in pages - {"README.md"} if f"({page})" not in index}


def test_python_in_readme_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    (block,) = re.findall(
        r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL
    )
    exec(compile(block, "README.md", "exec"), {})
    names, position = capsys.readouterr().out.splitlines()
    assert "car" in names
    assert float(position.strip("()").split(", ")[2]) < -4.0


def test_python_in_point_clouds_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "docs" / "how-to" / "point-clouds.md").read_text()
    (block,) = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "point-clouds.md", "exec"), {})
    voxels, _ = capsys.readouterr().out.split()
    assert int(voxels) > 1000
    assert (tmp_path / "wall.ply").stat().st_size > 1000
