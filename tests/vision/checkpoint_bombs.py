"""Small files that claim to be large, or that would keep a reader busy forever.

Each is a function that writes the file to a path (it may change the suffix), with a pattern of its error.
"""

from __future__ import annotations

import copy
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from vision.training.published import yolov8_description
from vision.yolo.architecture import build
from vision.yolo.checkpoint import FORMAT

DETECTION = "ultralytics.nn.tasks.DetectionModel"


def archive(path: Path, members: dict[str, bytes]) -> Path:
    """A zip archive of these members, and torch's version of its format."""
    with zipfile.ZipFile(path, "w") as file:
        root = next(iter(members)).partition("/")[0]
        for name, data in ({f"{root}/version": b"3\n"} | members).items():
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
    return named("torch._utils._rebuild_tensor_v2") + b"(" + source + b"K\x00(" + numbers + b"t(K\x01t\x89}tR"


def foreign(model_state: bytes) -> bytes:
    """A checkpoint whose model is one record with this state (pairs of keys and values)."""
    return b"}" + text("model") + named(DETECTION) + b")\x81}(" + model_state + b"ubs"


def described(path: Path, **changes: Any) -> Path:
    plain = yolov8_description((0.1, 0.01, 64), ("car", "dog")).to_plain() | changes
    torch.save({"format": FORMAT, "description": plain, "state_dict": {}, "metadata": {}}, path)
    return path


EMPTY_MEMBER = struct.pack("<4s4B4HL2L5H2L", b"PK\x01\x02", *[0] * 18)


def many_members(path: Path) -> Path:
    """A table of contents without members, forty-six bytes per entry."""
    contents = b"PK\x03\x04" + EMPTY_MEMBER * 200_000
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, len(contents) - 4, 4, 0)
    path.write_bytes(contents + end)
    return path


def hidden_members(path: Path) -> Path:
    """The same with zip64 records; in one, the signature is repeated where another size would follow."""
    contents = EMPTY_MEMBER * 40_000
    record = struct.pack("<4s4sL2H2L4Q", b"PK\x06\x06", b"PK\x06\x06", *[0] * 5, 9, 9, len(contents), 0)
    locator = struct.pack("<4sLQL", b"PK\x06\x07", 0, 4 + len(contents), 1)
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    path.write_bytes(b"PK\x03\x04" + contents + record + locator + end)
    return path


def two_sizes(path: Path) -> Path:
    """The end record has another size of the contents than the zip64 record."""
    content = bytearray(hidden_members(path).read_bytes())
    content[-10:-6] = (46).to_bytes(4, "little")
    path.write_bytes(content)
    return path


def member_without_bytes(path: Path) -> Path:
    """A storage whose member has 16 bytes, of which none are stored."""
    content = bytearray(pickled(path, tensor(storage("0", 4), 4), _0=b"").read_bytes())
    # The last entry's uncompressed size (APPNOTE 4.3.12).
    content[content.rfind(b"PK\x01\x02") + 24] = 16
    path.write_bytes(content)
    return path


def colliding_set(path: Path) -> Path:
    numbers = b"".join(b"\x8a\x0a" + (k * ((1 << 61) - 1)).to_bytes(10, "little") for k in range(9_999))
    return pickled(path, named("builtins.set") + b"](" + numbers + b"e\x85R")


def long_texts(path: Path, key: str, before: bytes = b"](", after: bytes = b"e") -> Path:
    """A description in which `key` has one long text many times."""
    texts = before + text("n" * 60_000) + b"q\x08" + b"h\x08" * 50_000 + after
    table = b"}(" + text("names") + b"]" + text("car") + b"a" + text(key) + texts + b"u"
    return pickled(path, b"}(" + text("format") + text(FORMAT) + text("description") + table + b"u")


def compressed(path: Path) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("m/version", b"3\n")
        file.writestr("m/data.pkl", b"\x80\x02" + b"]" * (60 << 20) + b".")
    return path


def colliding(path: Path) -> Path:
    numbers = b"".join(
        b"\x8a\x0a" + (k * ((1 << 61) - 1)).to_bytes(10, "little") + b"N" for k in range(60_000)
    )
    return pickled(path, b"}(" + numbers + b"u")


def numbered_weight(path: Path) -> Path:
    plain = yolov8_description((0.1, 0.01, 64), ("car",)).to_plain()
    weights = {"a": torch.zeros(1), 1: torch.zeros(1)}
    torch.save({"format": FORMAT, "description": plain, "state_dict": weights, "metadata": {}}, path)
    return path


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


def shared_bytes(path: Path) -> Path:
    """A thousand members that are the same megabyte of the file."""
    storages = b"".join(storage(f"{number}", 1 << 18) + b"a" for number in range(1000))
    data = b"\x80\x02]" + storages + b"."
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("m/version", b"3\n")
        file.writestr("m/data.pkl", data)
        file.writestr("m/data/0", bytes(1 << 20))
        for number in range(1, 1000):
            info = copy.copy(file.filelist[2])
            info.filename = f"m/data/{number}"
            file.filelist.append(info)
    return path


def large_call(name: str, count: int) -> Callable[[Path], Path]:
    """A call of an allowed name with one large number."""
    return lambda path: pickled(path, named(name) + b"\x8a\x08" + count.to_bytes(8, "little") + b"\x85R")


TOO_LARGE, TOO_SLOW = r"needs more than \d+ MiB", r"needs more than \d+ s of processor time"
# Each tuple contains the one before twice.
MAZE = b"]q\x09" + b"h\x09h\x09\x86q\x09" * 200
BOMBS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "lists": (lambda p: pickled(p, b"]" * (1 << 20)), TOO_LARGE),
    "dictionaries": (lambda p: pickled(p, b"}NNs" * (1 << 18)), TOO_LARGE),
    "tuples": (lambda p: pickled(p, b"N\x85" * (1 << 20)), TOO_LARGE),
    "remembered values": (
        lambda p: pickled(p, b"N" + b"".join(b"r" + k.to_bytes(4, "little") for k in range(1 << 18))),
        "not a detection checkpoint",
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
        TOO_LARGE,
    ),
    "empty tensors": (
        lambda p: pickled(p, tensor(storage("0", 4), 0) * 60_000, _0=bytes(16)),
        rf"{TOO_SLOW}|not a detection checkpoint",
    ),
    "a tensor larger than its storage": (
        lambda p: pickled(p, tensor(storage("0", 4), 1 << 38), _0=bytes(16)),
        "truncated or damaged",
    ),
    "a storage larger than its member": (
        lambda p: pickled(p, storage("0", 1 << 40), _0=bytes(16)),
        "truncated or damaged",
    ),
    "a tensor of a large size": (large_call("torch.Tensor", 1 << 40), TOO_LARGE),
    "bytes of a large size": (large_call("builtins.bytearray", 1 << 28), TOO_LARGE),
    "members that share their bytes": (shared_bytes, TOO_LARGE),
    "members": (many_members, "truncated or damaged"),
    "compression": (compressed, TOO_LARGE),
    "colliding keys": (colliding, TOO_SLOW),
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
    "a maze": (lambda p: pickled(p, b"}" + text("format") + b"(" + MAZE + b"ts"), r"has format \(\[\], \("),
    "a maze as a type's name": (
        lambda p: pickled(p, named("dill._dill._load_type") + b"(" + MAZE + b"tR"),
        r"asks for the type \(\[\], \(\[\], \[\]\)",
    ),
    "members hidden by a repeated signature": (hidden_members, "truncated or damaged"),
    "two sizes of the contents": (two_sizes, "truncated or damaged"),
    "a member without its bytes": (member_without_bytes, "truncated or damaged"),
    "a set of colliding numbers": (colliding_set, "not a detection checkpoint"),
    "a row of one text": (lambda p: long_texts(p, "backbone", b"](](", b"ee"), "too deep or too long"),
    "one text as all class names": (lambda p: long_texts(p, "names"), "too deep or too long"),
    "a number as a weight's name": (numbered_weight, "a weight named 1"),
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
