"""Damaged or hostile checkpoints: rejected by name, never run, without excessive memory."""

from __future__ import annotations

import collections
import contextlib
import copy
import pickle
import struct
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

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
from vision.yolo.checkpoint import (
    FORMAT,
    CheckpointError,
    UnsafeCheckpointError,
    load_checkpoint,
    save_checkpoint,
)
from vision.yolo.published import yolov8_description
from vision.yolo.safe_pickle import unpickle


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
    ("program", "refused"),
    [
        pytest.param(
            b"\x80\x02ctorch.nn.modules.conv\nConv2d\n}b.", "sets .*AllowedGlobal", id="state set on a class"
        ),
        pytest.param(
            b"\x80\x02ccollections\nOrderedDict\n}b.", "sets .*AllowedGlobal", id="state set on a type"
        ),
        pytest.param(
            b"\x80\x02ccollections\nOrderedDict\n)\x81.",
            r"instance .*collections\.OrderedDict",
            id="an instance of a function",
        ),
        pytest.param(b"\x80\x02X\x01\x00\x00\x00a)R.", "calls .*str", id="a text is called"),
        pytest.param(
            b"\x80\x02ctorch.nn.modules.conv\nConv2d\n)\x81)R.", "calls .*Stub", id="a record is called"
        ),
        pytest.param(b"\x80\x02]}b.", "sets .*list", id="state set on a list"),
        pytest.param(
            b"\x80\x02ccollections\nOrderedDict\n]\x85R.",
            "ordered dictionary",
            id="a dictionary filled by a call",
        ),
        pytest.param(
            b"\x80\x02ccollections\ndefaultdict\n]\x85R.",
            "default dictionary",
            id="a default dictionary, filled",
        ),
        pytest.param(
            b"\x80\x02cdill._dill\n_load_type\nX\x04\x00\x00\x00type\x85R.",
            r"type \('type',\)",
            id="a type by name",
        ),
        pytest.param(b"\x80\x02cdill._dill\n_load_type\n]\x85R.", r"type \(\[\],\)", id="a type by no name"),
        pytest.param(
            b"\x80\x02c__builtin__\ngetattr\nctorch.nn.modules.conv\nConv2d\n)\x81"
            b"X\x09\x00\x00\x00__class__\x86R.",
            "getattr",
            id="another method than the folded layer's own",
        ),
        pytest.param(
            b"\x80\x02c__builtin__\ngetattr\nctorch.nn.modules.conv\nConv2d\n"
            b"X\x0c\x00\x00\x00forward_fuse\x86R.",
            "getattr",
            id="a method of something else than a layer",
        ),
    ],
)
def test_misuse_of_allowed_names_is_rejected(tmp_path: Path, program: bytes, refused: str) -> None:
    with pytest.raises(UnsafeCheckpointError, match=rf"{refused}.*; nothing was run"):
        load_checkpoint(archive(tmp_path / "evil.pt", program))


def tensor_call(*arguments: Any) -> Any:
    return [Global("torch._utils", "_rebuild_tensor_v2"), arguments]


def storage(kind: str = "FloatStorage", key: str = "0", count: int = 4) -> Any:
    return ("PERSISTENT", ("storage", Global("torch", kind), key, "cpu", count))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        pytest.param((storage(), 0, (5,), (1,)), "than its storage", id="too long"),
        pytest.param((storage(), 1, (4,), (1,)), "than its storage", id="offset too far"),
        pytest.param((storage(), -1, (1,), (1,)), "impossible shape", id="before the storage"),
        pytest.param((storage(), 0, (2,), (-1,)), "impossible shape", id="backwards"),
        pytest.param((storage(), 0, (10**9,), (0,)), "than its storage", id="one number repeated"),
        pytest.param((storage(), 0, (2, 2), (1,)), "impossible shape", id="a stride missing"),
        pytest.param((storage(), 0, (True,), (1,)), "impossible shape", id="a size that is no number"),
        pytest.param((storage(), 0), "without a shape", id="no shape"),
        pytest.param(((1, 2), 0, (1,), (1,)), "impossible shape", id="no storage"),
        pytest.param((storage(count=5), 0, (1,), (1,)), "should have 5 numbers", id="storage too short"),
        pytest.param((storage(count=10**15), 0, (1,), (1,)), "should have", id="a storage without end"),
        pytest.param((storage(key="7"), 0, (1,), (1,)), "'7' is missing", id="storage missing"),
        pytest.param((storage(key="../version"), 0, (1,), (1,)), "is missing", id="another member"),
        pytest.param((storage(kind="Generator"), 0, (1,), (1,)), "torch.Generator", id="another kind"),
    ],
)
def test_a_tensor_outside_its_storage_is_rejected(
    tmp_path: Path, arguments: tuple[Any, ...], expected: str
) -> None:
    function, call = tensor_call(*arguments)
    pickled = dumped((function, call))[:-1]
    # Unpack the pair and call it: TUPLE2 at the end becomes REDUCE.
    assert pickled.endswith(b"\x86q" + pickled[-1:])
    program = pickled[:-3] + b"R."
    path = archive(tmp_path / "t.pt", program, {"data/0": bytes(16), "version": b"3"})
    with pytest.raises(CheckpointError, match=expected):
        load_checkpoint(path)


def test_endlessly_repeated_numbers_are_rejected(tmp_path: Path) -> None:
    function, call = tensor_call(storage(count=1000), 0, (1000,), (1,))
    one = dumped((function, call))[2:-1]
    program = b"\x80\x02](" + (one[:-3] + b"R") * 2000 + b"e."
    path = archive(tmp_path / "t.pt", program, {"data/0": bytes(4000)})
    size = path.stat().st_size
    with pytest.raises(CheckpointError, match="same numbers"):
        load_checkpoint(path)
    assert 1000 * 2000 > 4 * size


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


def test_a_missing_file_is_rejected_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no such .*\.pt"):
        load_checkpoint(tmp_path / "none.pt")
    with pytest.raises(CheckpointError, match="is a folder"):
        load_checkpoint(tmp_path)


def test_an_archive_without_a_model_is_rejected(tmp_path: Path) -> None:
    for value in ({"weights": 1}, [1, 2], {"model": None}, {"model": torch.zeros(2)}, {"ema": {"a": 1}}, 5):
        torch.save(value, tmp_path / "x.pt")
        with pytest.raises(CheckpointError, match="model"):
            load_checkpoint(tmp_path / "x.pt")


def test_two_members_that_share_their_bytes_are_rejected(tmp_path: Path) -> None:
    """Overlapping members make a small file large."""
    path = tmp_path / "overlap.pt"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("model/data.pkl", bytes(5000))
        for number in range(20):
            info = copy.copy(file.filelist[0])
            info.filename = f"model/data/{number}"
            file.filelist.append(info)
    with pytest.raises(CheckpointError, match=r"members .*larger .*file;"):
        load_checkpoint(path)


def test_a_program_for_torchscript_is_rejected_as_such(tmp_path: Path) -> None:
    path = archive(tmp_path / "s.pt", dumped({}), {"code/__torch__.py": b""})
    with pytest.raises(CheckpointError, match="TorchScript"):
        load_checkpoint(path)


def test_numbers_of_the_other_byte_order_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="big-endian"):
        load_checkpoint(archive(tmp_path / "b.pt", dumped({}), {"byteorder": b"big"}))


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


@settings(max_examples=300, deadline=None)
@given(program=st.binary(max_size=60))
def test_any_bytes_are_a_value_or_a_named_error(program: bytes) -> None:
    with contextlib.suppress(CheckpointError):
        unpickle(b"\x80\x02" + program, {}, lambda identity: None)


def refuse(identity: tuple[Any, ...]) -> Any:
    raise AssertionError(f"no storage was expected, got {identity}")


@pytest.mark.parametrize(
    "value",
    [
        None,
        [1, 255, 256, 65536, -1, 2**40, -(2**100), 0.5, True, False, "ä", "", ()],
        {"a": (1,), "b": (1, 2), "c": (1, 2, 3), "d": (1, 2, 3, 4), 5: []},
        [[]] * 3,
    ],
    ids=str,
)
def test_plain_values_are_read_as_python_reads_them(value: Any) -> None:
    assert unpickle(pickle.dumps(value, protocol=2), {}, refuse) == value


@pytest.mark.parametrize(
    ("program", "expected"),
    [
        (b"\x80\x04N.", "protocol 2"),
        (b"\x80\x02\x80\x02N.", "twice"),
        (b"\x80\x02NN.", "left over"),
        (b"\x80\x02.", "not there"),
        (b"\x80\x02e.", "no mark"),
        (b"\x80\x02(s.", "not there"),
        (b"\x80\x02h\x05.", "asks for value 5"),
        (b"\x80\x02}(Nu.", "without a value"),
        (b"\x80\x02}]Ns.", "type list"),
        (b"\x80\x02X\x01\x00\x00\x00\xff.", "not UTF-8"),
        (b"\x80\x02X" + struct.pack("<I", 2**32 - 1) + b"a", "in the middle"),
        (b"\x80\x02cno end", "without a name"),
        (b"\x80\x02V1\n.", "opcode b'V'"),
        (b"\x80\x02NQ.", "than a tuple"),
    ],
)
def test_invalid_pickle_program_is_rejected(program: bytes, expected: str) -> None:
    with pytest.raises(CheckpointError, match=expected):
        unpickle(program, {}, refuse)


def test_a_huge_memo_number_costs_no_memory() -> None:
    assert unpickle(b"\x80\x02Nr\xff\xff\xff\xff.", {}, refuse) is None


def test_an_ordered_dictionary_becomes_a_plain_one(tmp_path: Path) -> None:
    model = trained_model()
    save_checkpoint(tmp_path / "m.pt", model, metadata={})
    content = torch.load(tmp_path / "m.pt", weights_only=True)
    content["state_dict"] = collections.OrderedDict(content["state_dict"])
    content["state_dict"]._metadata = {"version": 1}
    torch.save(content, tmp_path / "m.pt")
    assert_same_maps(model, load_checkpoint(tmp_path / "m.pt").model)
