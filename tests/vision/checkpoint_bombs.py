"""Small files that claim to be large, or that would keep a reader busy forever.

Each is a function that writes the file to a path (it may change the suffix), with a pattern of its error.
"""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from vision.yolo.architecture import build
from vision.yolo.checkpoint import FORMAT
from vision.yolo.published import yolov8_description

DETECTION = "ultralytics.nn.tasks.DetectionModel"


def archive(path: Path, members: dict[str, bytes]) -> Path:
    """A zip archive of these members."""
    with zipfile.ZipFile(path, "w") as file:
        for name, data in members.items():
            file.writestr(name, data)
    return path


def text(value: str) -> bytes:
    data = value.encode()
    return b"X" + len(data).to_bytes(4, "little") + data


def named(name: str) -> bytes:
    module, _, kind = name.rpartition(".")
    return f"c{module}\n{kind}\n".encode()


def pickled(path: Path, program: bytes, **storages: bytes) -> Path:
    members = {f"m/data/{key[1:]}": data for key, data in storages.items()}
    return archive(path, {"m/data.pkl": b"\x80\x02" + program + b"."} | members)


def storage(key: str, count: int) -> bytes:
    number = b"\x8a\x08" + count.to_bytes(8, "little")
    return b"(" + text("storage") + named("torch.FloatStorage") + text(key) + text("cpu") + number + b"tQ"


def tensor(source: bytes, *size: int) -> bytes:
    numbers = b"".join(b"\x8a\x08" + n.to_bytes(8, "little") for n in size)
    return named("torch._utils._rebuild_tensor_v2") + b"(" + source + b"K\x00(" + numbers + b"t(K\x00tN}tR"


def foreign(model_state: bytes) -> bytes:
    """A checkpoint whose model is one record with this state (pairs of keys and values)."""
    return b"}" + text("model") + named(DETECTION) + b")\x81}(" + model_state + b"ubs"


def described(path: Path, **changes: Any) -> Path:
    plain = yolov8_description((0.1, 0.01, 64), ("car", "dog")).to_plain() | changes
    torch.save({"format": FORMAT, "description": plain, "state_dict": {}, "metadata": {}}, path)
    return path


def many_members(path: Path) -> Path:
    """A table of contents without members, forty-six bytes per entry."""
    member = struct.pack("<4s4B4HL2L5H2L", b"PK\x01\x02", *[0] * 18)
    contents = b"PK\x03\x04" + member * 200_000
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, len(contents) - 4, 4, 0)
    path.write_bytes(contents + end)
    return path


def compressed(path: Path) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("m/data.pkl", b"]" * (60 << 20))
    return path


def colliding(path: Path) -> Path:
    numbers = b"".join(
        b"\x8a\x0a" + (k * ((1 << 61) - 1)).to_bytes(10, "little") + b"N" for k in range(60_000)
    )
    return pickled(path, b"}(" + numbers + b"u")


def one_storage_for_all(path: Path) -> Path:
    torch.save(torch.zeros(1), path)
    model = build(yolov8_description((0.33, 0.25, 1024), ("car",))).eval()
    weights = model.state_dict()
    numbers = torch.zeros(max(value.numel() for value in weights.values()))
    shared = {
        name: numbers[: value.numel()].view(value.shape) if value.is_floating_point() else value
        for name, value in weights.items()
    }
    content = {"format": FORMAT, "description": model.description.to_plain(), "state_dict": shared}
    torch.save(content | {"metadata": {}}, path)
    return path


def pair(
    path: Path, header: bytes, description: bytes = b"format: mavlink-companion.yolo.v2\narchitecture: {}\n"
) -> Path:
    path = path.with_suffix(".safetensors")
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    path.with_suffix(".yaml").write_bytes(description)
    return path


MAZE = b"]q\x09" + b"h\x09h\x09\x86q\x09" * 200
BOMBS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "lists": (lambda p: pickled(p, b"]" * (6 << 20)), "makes more values"),
    "dictionaries": (lambda p: pickled(p, b"}NNs" * (1 << 20)), "makes more values"),
    "tuples": (lambda p: pickled(p, b"N\x85" * (3 << 20)), "makes more values"),
    "remembered values": (
        lambda p: pickled(p, b"N" + b"".join(b"r" + k.to_bytes(4, "little") for k in range(1 << 18))),
        "makes more values",
    ),
    "records filled from one": (
        lambda p: pickled(
            p,
            named(DETECTION)
            + b"q\x00}("
            + b"".join(b"M" + k.to_bytes(2, "little") + b"N" for k in range(40_000))
            + b"uq\x01"
            + b"h\x00)\x81h\x01b" * 100_000,
        ),
        "makes more values",
    ),
    "empty tensors": (
        lambda p: pickled(p, tensor(storage("0", 4), 0) * 60_000, _0=bytes(16)),
        "makes more values|impossible shape",
    ),
    "a tensor larger than its storage": (
        lambda p: pickled(p, tensor(storage("0", 4), 1 << 38), _0=bytes(16)),
        "impossible shape|larger than its storage",
    ),
    "a storage larger than its member": (
        lambda p: pickled(p, storage("0", 1 << 40), _0=bytes(16)),
        "should have 1099511627776 numbers",
    ),
    "members": (many_members, "table of contents has 9200000 bytes"),
    "compression": (compressed, "compressed"),
    "colliding keys": (colliding, "expected a small number"),
    "long names": (
        lambda p: pickled(
            p,
            foreign(
                text("yaml") + b"}" + text("names") + b"]" + text("_modules") + b"}("
                + text("n" * 3_000_000) + named(DETECTION) + b")\x81q\x05}" + text("_modules") + b"}("
                + b"".join(text(f"{k}") + named(DETECTION) + b")\x81" for k in range(3000)) + b"usbu"
            ),
        ),
        "a module whose name has",
    ),
    "a maze": (lambda p: pickled(p, b"}" + text("format") + b"(" + MAZE + b"ts"), "has format a tuple"),
    "layers": (
        lambda p: described(p, backbone=[[-1, 64, "C2f", [64]]] * 100, depth_multiple=1.0),
        "describes 6",
    ),
    "one storage for all weights": (one_storage_for_all, "same numbers"),
    "a header of brackets": (lambda p: pair(p, b'{"a":' + b"[]," * (1 << 20)), "not a safetensors"),
    "a header of tensors": (
        lambda p: pair(p, b'{"a":{"dtype":"F32","shape":[137438953472],"data_offsets":[0,549755813888]}}'),
        "not a safetensors",
    ),
    "a description of lists": (
        lambda p: pair(p, b"{}", b"a: [" + b"[]," * 600_000 + b"]"),
        "more than 100000 values",
    ),
    "nested aliases (billion laughs)": (
        lambda p: pair(p, b"{}", b"a: &a [x,x]\nb: &b [*a,*a,*a]\nc: [*b,*b,*b]\n"),
        "anchors and aliases",
    ),
    "a description with a tag": (
        lambda p: pair(p, b"{}", b"a: !!python/object/apply:os.system ['id']\n"),
        "was not run",
    ),
}  # fmt: skip
