"""The reader against hostile files: rejected with a reason, without running code or excessive memory.

Every file is read in a separate process (`checkpoint_memory.py`) that ends if anything tries to run.
"""

from __future__ import annotations

import json
import os
import random
import re
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.vision.checkpoint_bombs import BOMBS, archive
from vision.training.published import yolov8_description
from vision.weights import DEFAULT_WEIGHTS
from vision.yolo.architecture import build
from vision.yolo.checkpoint import CheckpointError, load_checkpoint, save_checkpoint

READER = Path(__file__).with_name("checkpoint_memory.py")
ROOT = Path(__file__).parent.parent.parent
REAL = (
    Path(os.environ.get("COMPANION_TEST_DATA", ROOT.parent / "shared" / "data"))
    / "models"
    / "yolov8n_coco.pt"
)
# Memory limit of reading, besides three times the file: `docs/models.md`.
FIXED_BYTES = 32 << 20
# Processor time; every file here takes a fraction of a second.
LONGEST_S = 5


def read_apart(*paths: Path) -> list[dict[str, Any]]:
    """Report of a separate process for each file; it may take a minute for all."""
    done = subprocess.run(
        [sys.executable, str(READER), str(DEFAULT_WEIGHTS), *map(str, paths)],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:] or done.stdout[-2000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def small_pt(folder: Path) -> Path:
    path = folder / "small.pt"
    torch.manual_seed(0)
    save_checkpoint(path, build(yolov8_description((0.1, 0.01, 64), ("car", "dog"))).eval(), metadata={})
    return path


def members_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def mutated(data: bytes, dice: random.Random) -> bytes:
    """A few bytes flipped, cut out, duplicated or inserted."""
    changed = bytearray(data)
    for _ in range(dice.randint(1, 4)):
        at = dice.randrange(len(changed))
        match dice.randrange(5):
            case 0:
                changed[at] ^= 1 << dice.randrange(8)
            case 1:
                del changed[at : at + dice.randint(1, 9)]
            case 2:
                changed[at:at] = changed[at : at + dice.randint(1, 30)]
            case 3:
                changed[at:at] = dice.choice([b"R", b"b", b"\x81", b"h\x00", b"\x85", b"]", b"a", b"0", b"u"])
            case _:
                other = dice.randrange(len(changed))
                changed[at : at + 8] = changed[other : other + 8]
    return bytes(changed)


def assert_harmless(path: Path, report: dict[str, Any]) -> None:
    assert report["outcome"].startswith(("loaded ", "CheckpointError: ", "UnsafeCheckpointError: ")), report
    assert report["outcome"].isprintable()
    limit = 3 * sum(each.stat().st_size for each in path.parent.glob(f"{path.stem}.*")) + FIXED_BYTES
    assert report["bytes"] <= limit, (path.name, report)
    assert report["seconds"] < LONGEST_S, (path.name, report)


def mutations(folder: Path, count: int) -> list[Path]:
    """So many of each kind."""
    ours = small_pt(folder)
    return [
        *mutated_pickles(ours, folder, count),
        *mutated_bytes(ours.read_bytes(), folder, count),
        *mutated_archives(ours.read_bytes(), folder, count),
        *mutated_pairs(ours, folder, count),
    ]


@pytest.mark.slow
def test_many_mutations_are_read_or_rejected_by_name(tmp_path: Path) -> None:
    paths = mutations(tmp_path, 48)
    if REAL.is_file():
        paths += mutated_pickles(REAL, tmp_path, 8, "r")
    for path, report in zip(paths, read_apart(*paths), strict=True):
        assert_harmless(path, report)


def mutated_pickles(source: Path, folder: Path, count: int, prefix: str = "m") -> list[Path]:
    """The archive is intact, its contents are not."""
    original = members_of(source)
    name = next(name for name in original if name.endswith("data.pkl"))
    return [
        archive(
            folder / f"{prefix}{seed}.pt", original | {name: mutated(original[name], random.Random(seed))}
        )
        for seed in range(count)
    ]


def mutated_bytes(data: bytes, folder: Path, count: int) -> list[Path]:
    """Truncated somewhere, or changed anywhere."""
    paths = []
    for seed in range(count):
        dice = random.Random(seed)
        paths.append(folder / f"b{seed}.pt")
        paths[-1].write_bytes(mutated(data, dice) if seed % 3 else data[: dice.randrange(len(data))])
    return paths


# Signature and length of each record of an archive (APPNOTE 4.3): local header, entry of the contents, end
# record, zip64 record and its locator.
RECORDS = {b"PK\x03\x04": 30, b"PK\x01\x02": 46, b"PK\x05\x06": 22, b"PK\x06\x06": 56, b"PK\x06\x07": 20}


def mutated_archives(data: bytes, folder: Path, count: int) -> list[Path]:
    """Records with other fields, records twice, and without some; the zip64 records are torch's."""
    paths = []
    for seed in range(count):
        dice, changed = random.Random(seed), bytearray(data)
        for _ in range(dice.randint(1, 3)):
            signature = dice.choice(list(RECORDS))
            places = [found.start() for found in re.finditer(re.escape(signature), changed)]
            if not places:
                continue
            at, length = dice.choice(places), RECORDS[signature]
            match dice.randrange(8):
                case 0:
                    changed[at:at] = changed[at : at + length]
                case 1:
                    del changed[at : at + length]
                case 2:
                    changed += changed[at : at + length]
                case _:
                    width = dice.choice((1, 2, 4, 8))
                    first = at + dice.randrange(4, length - width + 1)
                    other = dice.choice(
                        (0, 1, 16, at, len(data), 1 << 31, 0x06064B50, 0x08088B1F, (1 << 64) - 1)
                    )
                    changed[first : first + width] = (other % (1 << 8 * width)).to_bytes(width, "little")
        paths.append(folder / f"z{seed}.pt")
        paths[-1].write_bytes(changed)
    return paths


def mutated_pairs(source: Path, folder: Path, count: int) -> list[Path]:
    """Changed in the header of one file or the text of the other."""
    save_checkpoint(folder / "o.safetensors", load_checkpoint(source).model, metadata={"a": [1]})
    weights = (folder / "o.safetensors").read_bytes()
    table = yaml.safe_load((folder / "o.yaml").read_bytes())
    del table["weights"]  # Without the checksum, so that a damaged header is read.
    report = yaml.safe_dump(table).encode()
    length = int.from_bytes(weights[:8], "little") + 8
    paths = []
    for seed in range(count):
        dice, path = random.Random(seed), folder / f"p{seed}.safetensors"
        head = mutated(weights[:length], dice) if seed % 2 else weights[:length]
        path.write_bytes(head + weights[length:])
        path.with_suffix(".yaml").write_bytes(report if seed % 2 else mutated(report, dice))
        paths.append(path)
    return paths


OPCODES = st.sampled_from(
    [bytes([code]) for code in b"(N\x88\x89)t\x85\x86\x87]ae}suRb\x81Q"]
    + [
        b"K\x01",
        b"K\xff",
        b"M\xff\xff",
        b"J\x00\x00\x00\x80",
        b"\x8a\x02\xff\x7f",
        b"G" + struct.pack(">d", 1.5),
    ]
    + [b"X\x01\x00\x00\x00a", b"q\x00", b"h\x00", b"q\x01", b"h\x01"]
    + [b"X" + len(text).to_bytes(4, "little") + text for text in (b"model", b"format", b"storage", b"0")]
    + [
        b"c" + name.replace(".", "\n").encode() + b"\n"
        for name in ("collections.OrderedDict", "torch.FloatStorage", "torch.Size", "builtins.set")
    ]
    + [b"ctorch._utils\n_rebuild_tensor_v2\n", b"cultralytics.nn.tasks\nDetectionModel\n", b"cos\nsystem\n"]
)


@pytest.mark.usefixtures("untried")
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(OPCODES, max_size=40))
def test_any_pickle_program_gives_a_model_or_an_error(tmp_path: Path, program: list[bytes]) -> None:
    pickled = b"\x80\x02" + b"".join(program) + b"."
    path = archive(tmp_path / "a.pt", {"m/data.pkl": pickled, "m/data/0": bytes(16)})
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(path)
    assert str(caught.value).isprintable()


def test_bombs_and_mutations_are_rejected_by_name(tmp_path: Path) -> None:
    """A bomb is always rejected, for its reason; a mutation may be readable, and a real checkpoint is."""
    bombs = []
    for index, (make, _) in enumerate(BOMBS.values()):
        (folder := tmp_path / f"{index}").mkdir()
        bombs.append(make(folder / "bomb.pt"))
    real = [REAL] if REAL.is_file() else []
    paths = [*bombs, *mutations(tmp_path, 4), *real]
    reports = read_apart(*paths)
    for path, report in zip(paths, reports, strict=True):
        assert_harmless(path, report)
    for (name, (_, expected)), report in zip(BOMBS.items(), reports, strict=False):
        assert re.search(expected, report["outcome"]), (name, report)
    if real:
        report = reports[paths.index(REAL)]
        assert report["outcome"] == "loaded 80 classes"
        assert report["bytes"] < 3 * REAL.stat().st_size
