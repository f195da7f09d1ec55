"""A plain installation on an ARM board."""

from __future__ import annotations

import subprocess
import sys
import tomllib

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tools.notice import licences
from tools.resolve_aarch64 import PYTHONS, ROOT, resolve, unwanted

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
HARDWARE = {"cuda-python", "tensorrt"}  # come with the board's system, not from an index


def test_plain_installation_brings_no_torch_and_no_console() -> None:
    brought = licences(PROJECT["dependencies"])
    assert "onnxruntime" in brought
    assert not brought.keys() & {"torch", "aioconsole", "sympy"}
    assert not unwanted(list(brought))


def test_constraints_pin_every_requirement_within_its_bounds() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    extras = PROJECT["optional-dependencies"].values()
    texts = [*PROJECT["dependencies"], *(text for extra in extras for text in extra)]
    wanted = [Requirement(text) for text in texts if not text.startswith("mavlink-companion")]
    for requirement in wanted:
        name = canonicalize_name(requirement.name)
        if name not in HARDWARE:
            assert requirement.specifier.contains(pins[name]), requirement


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("python", PYTHONS)
def test_wheels_for_aarch64_are_complete_and_without_cuda(python: str) -> None:
    probe = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--no-deps", "idna"]
    if subprocess.run(probe, capture_output=True, check=False).returncode:
        pytest.skip("no package index can be reached")
    names = [package["metadata"]["name"] for package in resolve(python, PROJECT["dependencies"])]
    assert "onnxruntime" in names
    assert not unwanted(names)
