"""A copy of the simulator with its hot modules compiled by mypyc, for training on the whole autopilot.

    python -m tools.compile_simulator FOLDER
    PYTHONPATH=FOLDER companion learn train --policy …

The same flights as with pure Python, bit for bit, on the Python version and processor type that compiled it.
Needs the extra `dev` and a C compiler.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import tempfile
from pathlib import Path

import mavlink_sim

# Half of a step's time; more modules gain little. `LockstepVehicle.copy` pickles the vehicle: a subclass of a
# compiled class that is not compiled loses its own attributes there (`CollidingMultirotor`, of a scene).
MODULES = (
    "physics/airframe.py",
    "physics/rotor_control.py",
    "physics/rotations.py",
    "physics/estimate_errors.py",
    "physics/fallible_estimate.py",
    "flight/position_control.py",
)
_FUTURE = "from __future__ import annotations\n"
_CLASS = re.compile(r"^class ", re.MULTILINE)
# Otherwise a compiled class is neither pickled nor a base of one that is not compiled.
_DECORATED = "@mypyc_attr(serializable=True, allow_interpreted_subclasses=True)\nclass "
# A C compiler may otherwise join a product and a sum into one rounding, on processors that have it.
_SEPARATE_ROUNDING = "-ffp-contract=off"


def compile_simulator(folder: Path) -> None:
    """Write `folder`/mavlink_sim.

    Raises:
        FileExistsError: the folder exists.
        SystemExit: mypyc or the C compiler found an error.
    """
    # imported here: they are of the extra `dev`
    from mypyc.build import mypycify
    from setuptools import setup

    if folder.exists():
        raise FileExistsError(f"{folder} exists: remove it, or name another")
    folder.parent.mkdir(parents=True, exist_ok=True)
    source = Path(mavlink_sim.__file__).parent
    # it appears complete or not at all
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as name:
        work = Path(name) / folder.name
        package = work / source.name
        shutil.copytree(source, package, ignore=shutil.ignore_patterns("__pycache__"))
        # its imports for type checkers would make mypy read everything, with torch: minutes
        (package / "__init__.py").write_text("", encoding="utf-8")
        for module in MODULES:
            text = (package / module).read_text(encoding="utf-8")
            text = text.replace(_FUTURE, f"{_FUTURE}from mypy_extensions import mypyc_attr\n", 1)
            (package / module).write_text(_CLASS.sub(_DECORATED, text), encoding="utf-8")
        with contextlib.chdir(work):
            flags = ["--ignore-missing-imports", f"--cache-dir={os.devnull}"]
            paths = [f"{package.name}/{module}" for module in MODULES]
            extensions = mypycify([*flags, *paths], debug_level="0")
            for extension in extensions:
                extension.extra_compile_args.append(_SEPARATE_ROUNDING)
            build = ["--quiet", "build_ext", "--inplace"]
            setup(name=package.name, packages=[], py_modules=[], ext_modules=extensions, script_args=build)
            shutil.rmtree("build")
        shutil.copy(source / "__init__.py", package)
        work.rename(folder)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="New folder, for PYTHONPATH")
    try:
        compile_simulator(parser.parse_args().folder)
    except FileExistsError as error:
        raise SystemExit(str(error)) from None


if __name__ == "__main__":
    main()
