"""NOTICE has the licence of everything that is installed."""

from __future__ import annotations

import tomllib

import pytest

from tools import notice as tool
from tools.notice import FILE, ROOT, licences, notice

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PERMISSIVE = ("Apache-2.0", "BSD", "HPND", "ISC", "MIT", "PSF-2.0", "0BSD", "Zlib", "CC0-1.0", "EPL-2.0")


def test_notice_is_current() -> None:
    assert FILE.read_text() == notice()


def test_plain_installation_is_permissive_or_lgpl() -> None:
    base = licences(PROJECT["dependencies"])
    assert {"numpy", "onnxruntime", "pymavlink", "typing-extensions"} <= base.keys()
    others = {name: text for name, text in base.items() if not text.startswith(PERMISSIVE)}
    assert others == {"pymavlink": "LGPL-3.0"}


def test_gpl_is_of_the_console_alone() -> None:
    extras = PROJECT["optional-dependencies"]
    gpl = {
        extra: {name for name, text in licences(extras[extra]).items() if text.startswith("GPL")}
        for extra in extras
    }
    assert {extra: names for extra, names in gpl.items() if names} == {"service": {"aioconsole"}}


def test_unknown_package_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tool, "ELSEWHERE", {})
    with pytest.raises(LookupError, match="no-such-package"):
        licences(["no-such-package>=1"])
