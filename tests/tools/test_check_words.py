from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tools.check_words import findings, main


@pytest.mark.parametrize(
    "text",
    ["def _tell_it() -> None:", "class HeardState:", "# Keeper of it", "It is told.", "it counts as true"],
)
def test_listed_words_are_found_in_names_and_prose(text: str) -> None:
    ((line, word, instead),) = findings(f"first\n{text}\n")
    assert (line, bool(word), bool(instead)) == (2, True, True)


@pytest.mark.parametrize("text", ["fcntl.flock(file)", "a toll", "file.tell()", "hearth", "filmstrip"])
def test_other_words_are_not_found(text: str) -> None:
    assert list(findings(text)) == []


def test_a_finding_is_exit_code_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.py"
    path.write_text("told = 1\n")
    assert main([str(path)]) == 1
    assert capsys.readouterr().out.startswith(f"{path}:1: 'told'")
    path.write_text("sent = 1\n")
    assert main([str(path)]) == 0


@pytest.mark.parametrize("name", ["a.py", "a.md", "a.js", "a.html", "a.toml"])
def test_files_that_git_knows_are_read(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    subprocess.run(["git", "init", "-q"], check=True)
    Path(name).write_text("told\n")
    assert main([]) == 0
    subprocess.run(["git", "add", name], check=True)
    assert main([]) == 1
    assert capsys.readouterr().out.startswith(f"{name}:1: 'told'")
