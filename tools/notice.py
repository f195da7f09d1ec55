"""Writes NOTICE: the licence of everything that an installation brings, as the installed packages state it.

    python -m tools.notice

The requirements are those of pyproject.toml, and of each package those of its own metadata. Packages for
hardware and clusters, which a developer has not, are listed as ELSEWHERE says, without what they bring.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
FILE = ROOT / "NOTICE"
OWN = "mavlink-companion"
# Extras of others' extras, and what nobody installs to fly.
_UNLISTED = ("all", "dev")
# Licence texts in the metadata → SPDX, where they differ.
_SPDX = {
    "3-Clause BSD License": "BSD-3-Clause",
    "Apache 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD",
    "Eclipse Public License 2.0 (EPL-2.0)": "EPL-2.0",
    "ISC License": "ISC",
    "LGPLv3": "LGPL-3.0",
    "MIT License": "MIT",
    "OSI Approved :: Apache Software License": "Apache-2.0",
}
# Of packages whose metadata states none.
_UNSTATED = {"openexr": "BSD-3-Clause"}
ELSEWHERE = {
    "cuda-python": "NVIDIA Software License",
    "depthai": "MIT",
    "pyrealsense2": "Apache-2.0",
    "ray": "Apache-2.0",
    "tensorrt": "NVIDIA Software License",
}
# What the wheels hold besides.
_WHEELS = {
    "av": "its wheels hold FFmpeg with x264, GPL-2.0",
    "numpy": "its wheels hold OpenBLAS, BSD-3-Clause, and libgfortran, GPL-3.0 with GCC's runtime exception",
    "opencv-python-headless": "its wheels hold FFmpeg, LGPL-2.1, and OpenBLAS as NumPy's do",
    "small-gicp": "its wheels hold libgomp, GPL-3.0 with GCC's runtime exception",
    "torch": "its wheels hold libgomp, GPL-3.0 with GCC's runtime exception",
}


def notice() -> str:
    """The text of NOTICE.

    Raises:
        LookupError: a package of a plain installation is not installed, or one states no licence.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    base = licences(project["dependencies"])
    lines = [
        f"{OWN} is licensed under {project['license']}; see LICENSE.",
        "Written by `python -m tools.notice` from the metadata of the packages.",
        "",
        "A plain installation brings",
        *_rows(base),
    ]
    for extra, requirements in sorted(project["optional-dependencies"].items()):
        if extra not in _UNLISTED:
            lines += ["", f"The extra `{extra}` adds", *_rows(licences(requirements), without=base)]
    return "\n".join(lines) + "\n"


def licences(requirements: Iterable[str]) -> dict[str, str]:
    """Package → licence, of the requirements and of all that they require here."""
    found: dict[str, str] = {}
    waiting = [Requirement(text) for text in requirements]
    seen: set[tuple[str, str]] = set()
    while waiting:
        wanted = waiting.pop()
        name = canonicalize_name(wanted.name)
        if name == OWN or (name, str(sorted(wanted.extras))) in seen:
            continue
        seen.add((name, str(sorted(wanted.extras))))
        if name in ELSEWHERE:
            found[name] = ELSEWHERE[name]
            continue
        try:
            installed = distribution(name)
        except PackageNotFoundError:
            raise LookupError(f"{name} is not installed here, and has no licence in ELSEWHERE") from None
        found[name] = _licence(name)
        for text in installed.requires or ():
            further = Requirement(text)
            extras = ("", *wanted.extras)
            if further.marker is None or any(further.marker.evaluate({"extra": one}) for one in extras):
                waiting.append(further)
    return found


def _licence(name: str) -> str:
    metadata: Any = distribution(name).metadata  # its protocol in the standard library lacks `get`
    prefix = "License :: OSI Approved :: "
    lines = metadata.get_all("Classifier") or []
    classified = [line.removeprefix(prefix) for line in lines if line.startswith(prefix)]
    text = str(metadata.get("License") or "")
    if stated := metadata.get("License-Expression"):
        return str(stated)
    if len(classified) > 1:
        return " OR ".join(_SPDX.get(one, one) for one in classified)
    # Some metadata has the whole text of the licence.
    for stated in (text if 0 < len(text) < 40 else "", *classified):
        if stated:
            return str(_SPDX.get(stated, stated))
    if name in _UNSTATED:
        return _UNSTATED[name]
    raise LookupError(f"{name} states no licence; read it, and add it to _UNSTATED")


def _rows(packages: dict[str, str], without: Iterable[str] = ()) -> list[str]:
    named = sorted(packages.keys() - set(without))
    notes = {name: f" ({_WHEELS[name]})" if name in _WHEELS else "" for name in named}
    return [f"  {name}: {packages[name]}{notes[name]}" for name in named] or ["  nothing"]


if __name__ == "__main__":
    FILE.write_text(notice())
