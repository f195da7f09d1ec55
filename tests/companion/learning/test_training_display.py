"""The progress of a training in lines, without a terminal."""

from __future__ import annotations

import pytest

from companion.learning.training_display import TrainingDisplay


def test_line_is_shown_every_ten_seconds_and_at_the_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 100.0
    monkeypatch.setattr("time.monotonic", lambda: now_s)
    with TrainingDisplay("seed 3: ") as display:
        for step in range(2, 12, 2):
            now_s += 4.0
            display.show(step, 9, f"return {step}.0", 90.0 if step < 9 else None)
    assert capsys.readouterr().err.splitlines() == [
        "seed 3: step 6/9 return 6.0, 1.5 min left",
        "seed 3: step 10/9 return 10.0",
    ]


def test_terminal_gets_a_bar_with_the_figures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "100")
    with TrainingDisplay() as display:
        display.show(2, 5, "return 2.0", 90.0)
    shown = capsys.readouterr().err
    assert "step 2/5 return 2.0" in shown
    assert "min left" not in shown
