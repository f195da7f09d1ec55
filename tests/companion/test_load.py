"""The load of the computer in messages."""

from __future__ import annotations

import os

import pytest

from companion.load import busy_text


@pytest.mark.parametrize(
    ("load", "words"), [(1.9, ()), (2.0, ()), (2.6, ("2 cores", "load 3")), (18.2, ("load 18",))]
)
def test_busy_computer_is_named_with_cores_and_load(
    load: float, words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {0, 3}, raising=False)
    monkeypatch.setattr(os, "getloadavg", lambda: (load, 0.0, 0.0))
    text = busy_text()
    assert bool(text) == bool(words)
    assert [word for word in words if word not in text] == []
