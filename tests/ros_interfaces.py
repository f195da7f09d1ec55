"""Makes the ROS packages of our definitions that no wheel has: by ROS's own generators and gcc.

Run by the Python of a ROS that was installed from wheels (`make programs`): it writes into that environment.
Each package is one module of Python with the type support of Fast DDS alone.
"""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

from rosidl_adapter.msg import convert_msg_to_idl
from rosidl_generator_c import generate_c
from rosidl_generator_py import generate_py
from rosidl_generator_type_description import generate_type_hash
from rosidl_typesupport_c import generate_c as generate_type_support
from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c
from rosidl_typesupport_introspection_c import generate_c as generate_introspection

from companion.ros2.definitions import DEFINITIONS

PREFIX = Path(sys.prefix)
SHARE, LIBRARIES, SITE = PREFIX / "share", PREFIX / "lib", Path(sysconfig.get_path("purelib"))
PACKAGES = ("diagnostic_msgs", "tf2_msgs", "vision_msgs")
FAST_DDS = "rosidl_typesupport_fastrtps_c"
INTROSPECTION = "rosidl_typesupport_introspection_c"  # Fast DDS of Jazzy registers a type by it
LINKED = (FAST_DDS, INTROSPECTION, "rosidl_typesupport_c", "rosidl_runtime_c", "rcutils", "rmw", "fastcdr")


def generate(package: str, folder: Path) -> None:
    """Write the sources of one package, and its types' descriptions with their hashes."""
    (folder / "msg").mkdir(parents=True)
    names = [name.rpartition("/")[2] for name in DEFINITIONS if name.startswith(f"{package}/")]
    for name in names:
        text = Path("msg", f"{name}.msg")
        (folder / text).write_text(DEFINITIONS[f"{package}/msg/{name}"])
        convert_msg_to_idl(folder, package, text, folder / "msg")

    def arguments(generator: str) -> str:
        path = folder / f"{generator}.json"
        values = {
            "package_name": package,
            "output_dir": str(folder),
            "template_dir": str(SHARE / generator / "resource"),
            "idl_tuples": [f"{folder}:msg/{name}.idl" for name in names],
            "include_paths": [f"{other.name}:{other}" for other in SHARE.iterdir()],
            "target_dependencies": [],
            "type_description_tuples": [f"msg/{name}.idl:{folder}/msg/{name}.json" for name in names],
        }
        path.write_text(json.dumps(values))
        return str(path)

    generate_type_hash(arguments("rosidl_generator_type_description"))
    generate_c(arguments("rosidl_generator_c"))
    generate_typesupport_fastrtps_c(arguments(FAST_DDS))
    generate_introspection(arguments(INTROSPECTION))
    generate_type_support(arguments("rosidl_typesupport_c"), [FAST_DDS, INTROSPECTION])
    generate_py(arguments("rosidl_generator_py"), ["rosidl_typesupport_c"])
    for generator in ("rosidl_generator_c", FAST_DDS, INTROSPECTION):
        header = f"{generator}__visibility_control.h"
        content = (SHARE / generator / "resource" / f"{header}.in").read_text()
        for mark, value in (("@PROJECT_NAME@", package), ("@PROJECT_NAME_UPPER@", package.upper())):
            content = content.replace(mark, value)
        (folder / "msg" / header).write_text(content)


def build(package: str, folder: Path) -> None:
    """Compile the sources, and put the package into the environment."""
    includes = [f"-I{folder.parent}", f"-I{sysconfig.get_path('include')}", "-I" + numpy_include()]
    includes += [f"-I{path}" for path in (PREFIX / "include", *(PREFIX / "include").iterdir())]
    # C++ cannot compile these sources of C; the rest is compiled and linked by one command.
    run("gcc", "-fPIC", *includes, "-c", *folder.rglob("*.c"), cwd=folder)
    installed = SITE / package
    (installed / "msg").mkdir(parents=True, exist_ok=True)
    for source in folder.glob("msg/*.py"):
        (installed / "msg" / source.name).write_text(source.read_text())
    (installed / "__init__.py").write_text("")
    kinds = ("rosidl_generator_*", FAST_DDS, INTROSPECTION)
    libraries = [
        path for kind in kinds for path in LIBRARIES.glob(f"lib*__{kind}.so") if not path.is_symlink()
    ]
    libraries += [LIBRARIES / f"lib{name}.so" for name in LINKED]
    sources = (*folder.rglob("*.cpp"), *folder.glob("*.o"))
    module = installed / f"{package}_s__rosidl_typesupport_c.so"
    run("g++", "-shared", "-fPIC", *includes, *sources, *libraries, "-o", module, cwd=folder)
    for kind in (FAST_DDS, INTROSPECTION):  # ROS looks each up in a library of that name
        link = LIBRARIES / f"lib{package}__{kind}.so"
        link.unlink(missing_ok=True)
        link.symlink_to(module)
    (SHARE / package / "msg").mkdir(parents=True, exist_ok=True)
    for path in (*folder.glob("msg/*.json"), *folder.glob("msg/*.msg"), *folder.glob("msg/*.idl")):
        (SHARE / package / "msg" / path.name).write_text(path.read_text())


def numpy_include() -> str:
    import numpy

    return numpy.get_include()


def run(*command: str | Path, cwd: Path) -> None:
    subprocess.run(command, check=True, cwd=cwd)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as work:
        for each in PACKAGES:
            generate(each, Path(work, each))
            build(each, Path(work, each))
