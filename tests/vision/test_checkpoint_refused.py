"""Damaged or hostile checkpoints: rejected by name, never run, without excessive memory."""

from __future__ import annotations

import collections
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.torch_version import TorchVersion

from tests.vision.foreign_checkpoints import (
    FOREIGN,
    NAMES,
    Calls,
    Classes,
    Global,
    archive,
    as_foreign,
    assert_same_maps,
    dumped,
    foreign_classes,
    save_foreign,
    trained_model,
)
from vision.training.published import yolov8_description
from vision.yolo.checkpoint import (
    FORMAT,
    CheckpointError,
    UnsafeCheckpointError,
    load_checkpoint,
    save_checkpoint,
)

pytestmark = pytest.mark.usefixtures("untried")


def hostile(marker: Path) -> dict[str, Any]:
    import builtins
    import os
    import subprocess

    touch = f"touch {marker}"
    return {
        "posix.system": Calls(os.system, touch),
        "subprocess.Popen": Calls(subprocess.Popen, ["touch", str(marker)]),
        "eval": Calls(builtins.eval, f"open({str(marker)!r}, 'w')"),
        "exec": Calls(builtins.exec, f"open({str(marker)!r}, 'w')"),
        "open": Calls(open, str(marker), "w"),
        "getattr": Calls(getattr, "a text", "upper"),
        "torch.serialization.load": Calls(torch.load, str(marker)),
        "torch.hub.load": Calls(torch.hub.load, "x", "y"),
        "builtins.__import__": Global("builtins", "__import__"),
        "torch.nn.modules.module.Module.__setattr__": Global("torch.nn.modules.module", "Module.__setattr__"),
        "ultralytics.nn.tasks.torch_safe_load": Global("ultralytics.nn.tasks", "torch_safe_load"),
    }


@pytest.mark.parametrize("name", list(hostile(Path())))
def test_pickle_with_a_call_is_rejected_and_not_run(tmp_path: Path, name: str) -> None:
    marker = tmp_path / "it-ran"
    pickled = dumped({"model": None, "innocent": hostile(marker)[name]})
    path = archive(tmp_path / "evil.pt", pickled)
    with pytest.raises(UnsafeCheckpointError, match=name.rpartition(".")[2]) as caught:
        load_checkpoint(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not marker.exists()


def test_hidden_call_in_a_checkpoint_is_not_run(tmp_path: Path, foreign: Classes) -> None:
    import os

    marker = tmp_path / "it-ran"
    whole = as_foreign(trained_model(), foreign, callback=Calls(os.system, f"touch {marker}"))
    path = save_foreign(tmp_path / "evil.pt", whole)
    with pytest.raises(UnsafeCheckpointError, match=r"posix\.system"):
        load_checkpoint(path)
    assert not marker.exists()
    torch.load(path, weights_only=False)  # The file does contain a call.
    assert marker.exists()


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(b"ctorch.nn.modules.conv\nConv2d\n}b", id="state set on a class"),
        pytest.param(b"ccollections\nOrderedDict\n}b", id="state set on a type"),
        pytest.param(b"ctorch._utils\n_rebuild_parameter\n)\x81", id="an instance of a function"),
        pytest.param(b"X\x01\x00\x00\x00a)R", id="a text is called"),
        pytest.param(b"ctorch.nn.modules.conv\nConv2d\n)\x81)R", id="a record is called"),
        pytest.param(b"]}b", id="state set on a list"),
        pytest.param(b"cdill._dill\n_load_type\nX\x04\x00\x00\x00type\x85R", id="a type by name"),
        pytest.param(b"cdill._dill\n_load_type\n]\x85R", id="a type by no name"),
        pytest.param(
            b"c__builtin__\ngetattr\nctorch.nn.modules.conv\nConv2d\n)\x81X\x09\x00\x00\x00__class__\x86R",
            id="another method than the folded layer's own",
        ),
        pytest.param(
            b"c__builtin__\ngetattr\nctorch.nn.modules.conv\nConv2d\nX\x0c\x00\x00\x00forward_fuse\x86R",
            id="a method of something else than a layer",
        ),
    ],
)
def test_misuse_of_allowed_names_is_rejected(tmp_path: Path, program: bytes) -> None:
    path = archive(tmp_path / "evil.pt", b"\x80\x02}X\x05\x00\x00\x00model" + program + b"s.")
    with pytest.raises(CheckpointError, match=r"nothing was run|damaged") as caught:
        load_checkpoint(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).isprintable()
    assert [word for word in ("<class", "object at 0x") if word in str(caught.value)] == []


def storage(kind: str = "FloatStorage", key: str = "0", count: int = 4) -> Any:
    return ("PERSISTENT", ("storage", Global("torch", kind), key, "cpu", count))


@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param((storage(), 0, (5,), (1,)), id="too long"),
        pytest.param((storage(), 1, (4,), (1,)), id="offset too far"),
        pytest.param((storage(), -1, (1,), (1,)), id="before the storage"),
        pytest.param((storage(), 0, (2,), (-1,)), id="backwards"),
        pytest.param((storage(), 0, (2, 2), (1,)), id="a stride missing"),
        pytest.param((storage(), 0), id="no shape"),
        pytest.param(((1, 2), 0, (1,), (1,)), id="no storage"),
        pytest.param((storage(count=5), 0, (1,), (1,)), id="storage too short"),
        pytest.param((storage(count=10**15), 0, (1,), (1,)), id="a storage without end"),
        pytest.param((storage(key="7"), 0, (1,), (1,)), id="storage missing"),
        pytest.param((storage(key="../version"), 0, (1,), (1,)), id="another member"),
        pytest.param((storage(kind="Generator"), 0, (1,), (1,)), id="another kind"),
    ],
)
def test_a_tensor_outside_its_storage_is_rejected(tmp_path: Path, arguments: tuple[Any, ...]) -> None:
    pickled = dumped((Global("torch._utils", "_rebuild_tensor_v2"), (*arguments, False, {})))[:-1]
    # Unpack the pair and call it: TUPLE2 at the end becomes REDUCE.
    assert pickled.endswith(b"\x86q" + pickled[-1:])
    path = archive(tmp_path / "t.pt", pickled[:-3] + b"R.", {"data/0": bytes(16)})
    with pytest.raises(CheckpointError, match=r"damaged|nothing was run"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: torch.zeros(2).to_sparse(), "not a tensor of numbers"),
        (lambda: torch.zeros(2, device="meta"), "not a tensor of numbers"),
        (lambda: torch.quantize_per_tensor(torch.zeros(2), 1.0, 0, torch.qint8), "not a tensor of numbers"),
        (lambda: torch.zeros(1).expand(10**12), "same numbers"),
    ],
    ids=["sparse", "without numbers", "quantized", "one number repeated"],
)
def test_weight_that_is_no_plain_array_is_rejected(
    tmp_path: Path, make: Callable[[], Tensor], expected: str
) -> None:
    description = yolov8_description((0.1, 0.01, 64), NAMES).to_plain()
    content = {"format": FORMAT, "description": description, "state_dict": {"a": make()}, "metadata": {}}
    torch.save(content, tmp_path / "m.pt")
    with pytest.raises(CheckpointError, match=expected):
        load_checkpoint(tmp_path / "m.pt")


def test_torch_whose_reader_runs_code_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """CVE-2026-24747."""
    save_checkpoint(tmp_path / "m.pt", trained_model(), metadata={})
    monkeypatch.setattr(torch, "__version__", TorchVersion("2.9.1+cpu"))
    with pytest.raises(CheckpointError, match=r"torch 2\.10 .* 2\.9\.1"):
        load_checkpoint(tmp_path / "m.pt")


def test_strides_that_repeat_one_number_cost_no_memory(tmp_path: Path, foreign: Classes) -> None:
    whole = as_foreign(trained_model(), foreign)
    for strides in (torch.zeros(1).expand(10**12), torch.zeros(1, 1).expand(10**6, 10**6)):
        whole.model[-1].stride = strides
        with pytest.raises(CheckpointError, match="has strides"):
            load_checkpoint(save_foreign(tmp_path / "f.pt", whole))


def test_text_that_is_no_unicode_is_printable(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "m.pt", trained_model(), metadata={"licence": "LICENCE"})
    with zipfile.ZipFile(tmp_path / "m.pt") as file:
        members = {name.partition("/")[2]: file.read(name) for name in file.namelist()}
    pickled = members.pop("data.pkl").replace(b"LICENCE", b"LIC\xed\xa0\x80E")
    loaded = load_checkpoint(archive(tmp_path / "m.pt", pickled, members))
    assert loaded.metadata["licence"].isprintable()


def test_a_network_larger_than_its_file_costs_no_memory(tmp_path: Path) -> None:
    description = yolov8_description((1.0, 16.0, 1 << 14), NAMES).to_plain()
    torch.save(
        {"format": FORMAT, "description": description, "state_dict": {}, "metadata": {}}, tmp_path / "m.pt"
    )
    with pytest.raises(CheckpointError, match="missing"):
        load_checkpoint(tmp_path / "m.pt")


@pytest.mark.parametrize("depth", [5, 14, 60, 50_000])
def test_nested_references_are_rejected_at_once(tmp_path: Path, depth: int) -> None:
    """Each tuple contains the one before twice: a few bytes whose copy or text would never end."""
    program = dumped({"format": FORMAT})[:-1] + b"(" + dumped("description")[2:-1]
    program += b"]q\x09" + b"h\x09h\x09\x86q\x09" * depth + b"u."
    with pytest.raises(CheckpointError):
        load_checkpoint(archive(tmp_path / "m.pt", program))


def test_unprintable_name_of_a_class_or_weight_is_rejected(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "m.pt", trained_model(), metadata={})
    content = torch.load(tmp_path / "m.pt", weights_only=True)
    content["state_dict"]["\x1b\n"] = torch.zeros(1)
    for name in ("", "\x1b[2Jcar", "a\nb"):
        content["description"]["names"] = [name, "dog"]
        torch.save(content, tmp_path / "m.pt")
        with pytest.raises(CheckpointError, match=r"class name .* printable") as caught:
            load_checkpoint(tmp_path / "m.pt")
        assert str(caught.value).isprintable()
    content["description"]["names"] = ["car", "dog"]
    torch.save(content, tmp_path / "m.pt")
    with pytest.raises(CheckpointError, match="1 unknown") as caught:
        load_checkpoint(tmp_path / "m.pt")
    assert str(caught.value).isprintable()


# Damaged files


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        pytest.param(b"", "is empty", id="empty"),
        pytest.param(b"hello", "not a checkpoint", id="text"),
        pytest.param(pickle.dumps({"model": 1}), "not a checkpoint", id="a bare pickle"),
        pytest.param(
            b"PK\x03\x04" + bytes(100), "truncated or damaged", id="only the beginning of an archive"
        ),
    ],
)
def test_a_file_of_another_kind_is_rejected_in_one_line(
    tmp_path: Path, content: bytes, expected: str
) -> None:
    path = tmp_path / "x.pt"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=expected) as caught:
        load_checkpoint(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_an_archive_without_a_model_is_rejected(tmp_path: Path) -> None:
    for value in ({"weights": 1}, [1, 2], {"model": None}, {"model": torch.zeros(2)}, {"ema": {"a": 1}}, 5):
        torch.save(value, tmp_path / "x.pt")
        with pytest.raises(CheckpointError, match="model"):
            load_checkpoint(tmp_path / "x.pt")


def test_a_program_for_torchscript_is_rejected_as_such(tmp_path: Path) -> None:
    path = archive(tmp_path / "s.pt", dumped({}), {"constants.pkl": b""})
    with pytest.raises(CheckpointError, match="TorchScript"):
        load_checkpoint(path)


@pytest.fixture(scope="module")
def own_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("own") / "m.pt"
    save_checkpoint(path, trained_model(), metadata={"licence": "Apache-2.0"})
    return path.read_bytes()


@pytest.fixture(scope="module")
def foreign_pickle(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, dict[str, bytes]]:
    """The pickle of a foreign checkpoint and the other members of its archive."""
    with pytest.MonkeyPatch.context() as patch:
        classes = foreign_classes(patch, FOREIGN)
        path = save_foreign(tmp_path_factory.mktemp("foreign") / "f.pt", as_foreign(trained_model(), classes))
    with zipfile.ZipFile(path) as file:
        members = {name.partition("/")[2]: file.read(name) for name in file.namelist()}
    return members.pop("data.pkl"), members


def test_a_truncated_file_is_rejected_at_every_length(tmp_path: Path, own_bytes: bytes) -> None:
    path = tmp_path / "cut.pt"
    lengths = {
        *range(0, 200, 7),
        *range(0, len(own_bytes), 1999),
        *range(len(own_bytes) - 60, len(own_bytes)),
    }
    for length in sorted(lengths):
        path.write_bytes(own_bytes[:length])
        with pytest.raises(CheckpointError) as caught:
            load_checkpoint(path)
        assert type(caught.value) is CheckpointError
        assert str(path) in str(caught.value)


@pytest.mark.parametrize("step", [9973, pytest.param(997, marks=pytest.mark.slow)])
def test_truncated_pickle_is_rejected_at_several_lengths(
    tmp_path: Path, foreign_pickle: tuple[bytes, dict[str, bytes]], step: int
) -> None:
    pickled, members = foreign_pickle
    for length in range(0, len(pickled), step):
        with pytest.raises(CheckpointError):
            load_checkpoint(archive(tmp_path / "cut.pt", pickled[:length], members))


EDITS = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=12)
UNHURRIED = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def loads_or_names_the_reason(path: Path) -> None:
    reason = ""
    try:
        load_checkpoint(path)
    except CheckpointError as error:
        reason = str(error)
    assert not reason or reason.startswith(str(path))
    assert "\n" not in reason


@UNHURRIED
@given(edits=EDITS)
def test_a_file_with_changed_bytes_loads_or_is_rejected(
    tmp_path: Path, own_bytes: bytes, edits: list[tuple[float, int]]
) -> None:
    changed = bytearray(own_bytes)
    for where, value in edits:
        # Headers and directory are at both ends; the numbers between are less interesting.
        half = 30_000
        position = int(where * 2 * half)
        changed[position if position < half else len(changed) - 2 * half + position] = value
    (tmp_path / "changed.pt").write_bytes(changed)
    loads_or_names_the_reason(tmp_path / "changed.pt")


@settings(UNHURRIED, max_examples=30)
@given(edits=EDITS)
def test_a_pickle_with_changed_bytes_loads_or_is_rejected(
    tmp_path: Path, foreign_pickle: tuple[bytes, dict[str, bytes]], edits: list[tuple[float, int]]
) -> None:
    pickled, members = foreign_pickle
    changed = bytearray(pickled)
    for where, value in edits:
        changed[int(where * len(changed))] = value
    loads_or_names_the_reason(archive(tmp_path / "changed.pt", bytes(changed), members))


@settings(UNHURRIED, max_examples=300)
@given(program=st.binary(max_size=60))
def test_any_bytes_as_pickle_are_rejected(tmp_path: Path, program: bytes) -> None:
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(archive(tmp_path / "any.pt", b"\x80\x02" + program))
    assert str(caught.value).isprintable()


def test_an_ordered_dictionary_becomes_a_plain_one(tmp_path: Path) -> None:
    model = trained_model()
    save_checkpoint(tmp_path / "m.pt", model, metadata={})
    content = torch.load(tmp_path / "m.pt", weights_only=True)
    content["state_dict"] = collections.OrderedDict(content["state_dict"])
    content["state_dict"]._metadata = {"version": 1}
    torch.save(content, tmp_path / "m.pt")
    assert_same_maps(model, load_checkpoint(tmp_path / "m.pt").model)
