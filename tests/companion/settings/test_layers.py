"""The layers of settings: defaults, system, user, `--config`, environment, flags."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.settings.layers import user_file


def test_user_file_is_in_the_configuration_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert user_file() == tmp_path / "companion" / "companion.toml"


@pytest.mark.parametrize("home", [None, "", "relative"])
def test_user_file_is_below_the_home_by_default(
    home: str | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    if home is None:
        monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    else:
        monkeypatch.setenv("XDG_CONFIG_HOME", home)
    assert user_file() == tmp_path / ".config" / "companion" / "companion.toml"
