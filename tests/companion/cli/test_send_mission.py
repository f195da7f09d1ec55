"""`companion send --file --check`."""

from __future__ import annotations

from pathlib import Path

from tests.companion.command_line import companion_here


def test_cli_checks_a_mission_and_prints_its_plan(exported_model: Path, tmp_path: Path) -> None:
    options = ("--check", "--model", exported_model)
    done = companion_here("send", "--file", "demo", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    title, first = done.stdout.splitlines()[:2]
    assert title == "mission demo: 5 steps"
    assert first.startswith("1. takeoff altitude=4 → find; ")
    assert first.endswith("failure → rtl")
    (tmp_path / "bad.toml").write_text("[[step]]\nname = 'look'\ndo = 'seek zebra'\n")
    done = companion_here("send", "--file", "bad.toml", *options, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("companion: bad.toml: ")
    assert "step 1" in done.stderr
    assert "'zebra'" in done.stderr
    assert done.stderr.count("\n") == 1
    done = companion_here("send", "--file", "demo", *options, "--detector-runtime", "torch", cwd=tmp_path)
    assert done.returncode == 2
    assert ".onnx" in done.stderr
