"""What the wheel and the source distribution hold."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
BUILD = "import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"


def build(tmp_path: Path, hook: str) -> Path:
    """Run a hook of PEP 517 on a copy of the sources, so that nothing is left in the checkout."""
    copy = tmp_path / "copy"
    unwanted = shutil.ignore_patterns(".*", "*.egg-info", "build", "demo-output", "__pycache__")
    shutil.copytree(ROOT, copy, ignore=unwanted)
    done = subprocess.run(
        [sys.executable, "-c", BUILD, hook, str(tmp_path)],
        cwd=copy,
        capture_output=True,
        text=True,
        timeout=110,
    )
    assert done.returncode == 0, done.stderr
    return tmp_path / done.stdout.splitlines()[-1]


def test_wheel_holds_the_packages_and_their_data(tmp_path: Path) -> None:
    names = zipfile.ZipFile(build(tmp_path, "build_wheel")).namelist()
    packages = {name.split("/")[0] for name in names if name.endswith(".py")}
    assert packages == {"companion", "vision", "mavlink_sim"}
    sources = [
        *ROOT.glob("companion/**/*.py"),
        *ROOT.glob("vision/**/*.py"),
        *ROOT.glob("mavlink_sim/**/*.py"),
    ]
    wanted = {path.relative_to(ROOT).as_posix() for path in sources}
    wanted |= {path.relative_to(ROOT).as_posix() for path in ROOT.glob("mavlink_sim/scenes/*.toml")}
    wanted |= {path.relative_to(ROOT).as_posix() for path in ROOT.glob("vision/weights/default.*")}
    wanted |= {path.relative_to(ROOT).as_posix() for path in ROOT.glob("companion/dashboard/page/*")}
    wanted |= {path.relative_to(ROOT).as_posix() for path in ROOT.glob("companion/guidance/policies/*.onnx")}
    wanted |= {f"companion/setup/systemd/{path.name}" for path in ROOT.glob("systemd/*")}
    wanted |= {f"{package}/py.typed" for package in packages}
    assert wanted <= set(names), sorted(wanted - set(names))


def test_source_distribution_holds_what_a_build_needs(tmp_path: Path) -> None:
    with tarfile.open(build(tmp_path, "build_sdist")) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {
        "pyproject.toml",
        "README.md",
        "LICENSE",
        "NOTICE",
        "companion/setup/systemd/companion.service",
    } <= names
