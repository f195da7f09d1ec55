"""Resolves a plain installation for an ARM board, and refuses what it must not bring. Needs a package index.

    python -m tools.resolve_aarch64          # Python 3.11 to 3.14

pip resolves the requirements of pyproject.toml for Linux on aarch64, from wheels alone, and installs nothing.
The exit code is 1 if a wheel is missing, or if a package of CUDA is among them.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
# Of glibc 2.17 to 2.36: Debian 12, and Raspberry Pi OS of it, have 2.36.
PLATFORMS = tuple(f"manylinux_2_{minor}_aarch64" for minor in range(36, 16, -1))
_CUDA = ("cuda", "nvidia", "triton")


def resolve(python: str, requirements: list[str]) -> list[dict[str, Any]]:
    """The packages of pip's report.

    Raises:
        LookupError: pip finds no wheel of a package. The message is its last line.
    """
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
    command += ["--report", "-", "--only-binary=:all:", "--target", "unused", "--implementation", "cp"]
    command += [
        "--python-version",
        python,
        "--abi",
        f"cp{python.replace('.', '')}",
        "--abi",
        "abi3",
        "--abi",
        "none",
    ]
    command += [word for platform in PLATFORMS for word in ("--platform", platform)]
    done = subprocess.run([*command, *requirements], capture_output=True, text=True, check=False)
    if done.returncode:
        raise LookupError(done.stderr.strip().splitlines()[-1])
    packages: list[dict[str, Any]] = json.loads(done.stdout)["install"]
    return packages


def unwanted(names: list[str]) -> list[str]:
    """Those of the packages that are of CUDA."""
    return [name for name in names if name.lower().startswith(_CUDA)]


def main() -> int:
    """Resolve for each Python; returns the exit code."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    failed = False
    for python in PYTHONS:
        try:
            packages = resolve(python, project["dependencies"])
        except LookupError as error:
            print(f"Python {python}: {error}")
            failed = True
            continue
        names = [package["metadata"]["name"] for package in packages]
        refused = unwanted(names)
        failed = failed or bool(refused)
        print(f"Python {python}: {len(names)} packages{': ' + ', '.join(refused) if refused else ''}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
