"""A reader of pickles that cannot run code: the part of the pickle machine that `torch.save` writes.

Python's own unpickler imports what a file names and calls it. This one handles tokens only: a global is
looked up in the caller's table of allowed names, "calling" it creates a `Stub` record or calls the table's
function, and setting state fills a record's dictionary. There are no imports, no attribute access on real
objects and no classes chosen by the file. The opcodes are those of pickle protocol 2 (PEP 307); any other is
rejected.

The memory of the values is counted as they are created, and a pickle that expands too much is rejected: a
list is one byte in the file and sixty in memory, and a filled dictionary can be copied by five more bytes.
"""

from __future__ import annotations

import reprlib
import struct
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any


class CheckpointError(ValueError):
    """A checkpoint that cannot be read; one line with the file, the reason, and what to do."""


class UnsafeCheckpointError(CheckpointError):
    """A checkpoint that requests a function call; the message names it."""


@dataclass(slots=True, eq=False)
class Stub:
    """Stand-in for an object of class `name`: its constructor's arguments and its attributes."""

    name: str
    arguments: tuple[Any, ...] = ()
    state: dict[Any, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class AllowedGlobal:
    """A global that the file may name. `make` is called with the arguments of a call.

    Without `make` a call, or an instance, is a `Stub` of this name.
    """

    name: str
    make: Callable[[tuple[Any, ...]], Any] | None = None

    def call(self, arguments: tuple[Any, ...]) -> Any:
        return Stub(self.name, arguments) if self.make is None else self.make(arguments)


def one_line(message: str) -> str:
    """A message that may quote the file: control characters escaped, at most 2000 characters."""
    return "".join(
        character if character.isprintable() else repr(character)[1:-1]
        for character in message[:_LONGEST_MESSAGE]
    )


_LONGEST_MESSAGE = 2000
_MARK = object()
_SCALARS = (str, int, float, bool, type(None))
# No checkpoint has larger integer keys; larger ones can be chosen to collide in a dictionary.
_LARGEST_KEY = 1 << 20
# Memory of values in CPython, bytes, rounded up.
_REFERENCE_BYTES = 8
_OBJECT_BYTES = 64
_PAIR_BYTES = 128
_MEMO_BYTES = 128
_CALL_BYTES = 768
_DEFAULT_ALLOWANCE_BYTES = 16 << 20


class _Excerpt(reprlib.Repr):
    """The beginning of a value's text: the whole text of a container can exceed any memory."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxstring = 3, 100
        self.maxlist = self.maxtuple = self.maxdict = 8

    def repr_instance(self, value: object, level: int) -> str:
        return repr(value) if isinstance(value, _SCALARS) else f"a {type(value).__name__}"


def shown(value: object) -> str:
    """A value from a file for a message: at most 200 characters, made in bounded time and memory."""
    return _Excerpt().repr(value)[:200]


def check_key(value: object, what: str) -> None:
    """Reject a dictionary's key or a set's member whose hash is slow to compute, or chosen to collide."""
    # Hashing a nested tuple can be made very slow; no checkpoint needs one as a key.
    if not isinstance(value, _SCALARS):
        raise CheckpointError(f"its pickle has a {what} of type {type(value).__name__}")
    if isinstance(value, int | float) and not -_LARGEST_KEY < value < _LARGEST_KEY:
        raise CheckpointError(f"its pickle has the {what} {shown(value)}; expected a small number")


def unpickle(
    data: bytes,
    allowed: Mapping[str, AllowedGlobal],
    persistent: Callable[[tuple[Any, ...]], Any],
    allowance_bytes: int = _DEFAULT_ALLOWANCE_BYTES,
    unsupported: Callable[[str], str | None] = lambda name: None,
) -> Any:
    """Read the value that `data` describes.

    Args:
        data: a pickle of protocol 2.
        allowed: `module.name` → its replacement.
        persistent: resolves a persistent id (for torch: a storage).
        allowance_bytes: memory limit of the values, without storages.
        unsupported: the error for a name that is genuine but not supported; None for any other name.

    Raises:
        UnsafeCheckpointError: a global that is not allowed; the message names it.
        CheckpointError: not such a pickle.
    """
    return _Machine(data, allowed, persistent, allowance_bytes, unsupported).run()


class _Machine:
    def __init__(
        self,
        data: bytes,
        allowed: Mapping[str, AllowedGlobal],
        persistent: Callable[[tuple[Any, ...]], Any],
        allowance_bytes: int,
        unsupported: Callable[[str], str | None],
    ) -> None:
        self._unsupported = unsupported
        self._data = data
        self._position = 0
        self._allowed = allowed
        self._persistent = persistent
        self._left_bytes = allowance_bytes
        self._stack: list[Any] = []
        # A dictionary, not a list: the file chooses the numbers, and a huge one must not cost memory.
        self._memo: dict[int, Any] = {}

    def run(self) -> Any:
        if self._take(2) != b"\x80\x02":
            raise CheckpointError("its pickle is not of protocol 2, which torch.save writes")
        while (opcode := self._take(1)) != b".":
            handler = _HANDLERS.get(opcode)
            if handler is None:
                raise CheckpointError(f"its pickle has opcode {opcode!r}, which torch.save does not write")
            # Its entry on the stack; handlers count what they create beyond that.
            self._left_bytes -= _REFERENCE_BYTES
            handler(self)
            if self._left_bytes < 0:
                raise CheckpointError("its pickle makes more values than a checkpoint needs")
        value = self._pop()
        if self._stack:
            raise CheckpointError("its pickle ends with values left over")
        return value

    def _spend(self, count: int) -> None:
        """Count bytes before a large allocation; reject if the limit is exceeded."""
        self._left_bytes -= count
        if self._left_bytes < 0:
            raise CheckpointError("its pickle makes more values than a checkpoint needs")

    def _take(self, count: int) -> bytes:
        chunk = self._data[self._position : self._position + count]
        if len(chunk) != count:
            raise CheckpointError("its pickle ends in the middle")
        self._position += count
        return chunk

    def _unsigned(self, count: int) -> int:
        return int.from_bytes(self._take(count), "little")

    def _line(self) -> str:
        end = self._data.find(b"\n", self._position)
        if end < 0 or end - self._position > 1000:
            raise CheckpointError("its pickle has a global without a name")
        line = self._take(end - self._position)
        self._position += 1
        return _text(line)

    def _pop(self) -> Any:
        if not self._stack or self._stack[-1] is _MARK:
            raise CheckpointError("its pickle takes a value that is not there")
        return self._stack.pop()

    def _pop_to_mark(self) -> list[Any]:
        values: list[Any] = []
        while True:
            if not self._stack:
                raise CheckpointError("its pickle has no mark where one is needed")
            value = self._stack.pop()
            if value is _MARK:
                values.reverse()
                return values
            values.append(value)

    def _push(self, value: Any) -> None:
        self._stack.append(value)

    def _make(self, value: Any) -> None:
        """Push a new value, not a shared one."""
        self._left_bytes -= sys.getsizeof(value)
        self._stack.append(value)

    def _top(self, kind: type) -> Any:
        if not self._stack or not isinstance(self._stack[-1], kind):
            raise CheckpointError(f"its pickle fills a {kind.__name__} that is not there")
        return self._stack[-1]

    def proto(self) -> None:
        raise CheckpointError("its pickle declares its protocol twice")

    def mark(self) -> None:
        self._push(_MARK)

    def integer(self) -> None:
        self._make(struct.unpack("<i", self._take(4))[0])

    def long(self) -> None:
        self._make(int.from_bytes(self._take(self._unsigned(1)), "little", signed=True))

    def real(self) -> None:
        self._make(struct.unpack(">d", self._take(8))[0])

    def text(self) -> None:
        self._make(_text(self._take(self._unsigned(4))))

    def tuple_to_mark(self) -> None:
        self._make(tuple(self._pop_to_mark()))

    def tuple_of(self, count: int) -> None:
        values = [self._pop() for _ in range(count)]
        self._make(tuple(reversed(values)))

    def append(self) -> None:
        value = self._pop()
        self._left_bytes -= _REFERENCE_BYTES
        self._top(list).append(value)

    def appends(self) -> None:
        values = self._pop_to_mark()
        self._spend(_REFERENCE_BYTES * len(values))
        self._top(list).extend(values)

    def set_item(self) -> None:
        value, key = self._pop(), self._pop()
        self._fill([key, value])

    def set_items(self) -> None:
        self._fill(self._pop_to_mark())

    def _fill(self, values: list[Any]) -> None:
        target = self._top(dict)
        if len(values) % 2:
            raise CheckpointError("its pickle has a dictionary key without a value")
        self._spend(_OBJECT_BYTES + _PAIR_BYTES * (len(values) // 2))
        for key, value in zip(values[::2], values[1::2], strict=True):
            check_key(key, "dictionary key")
            target[key] = value

    def put(self, width: int) -> None:
        index = self._unsigned(width)
        if not self._stack or self._stack[-1] is _MARK:
            raise CheckpointError("its pickle remembers a value that is not there")
        self._left_bytes -= _MEMO_BYTES
        self._memo[index] = self._stack[-1]

    def get(self, width: int) -> None:
        index = self._unsigned(width)
        if index not in self._memo:
            raise CheckpointError(f"its pickle asks for value {index}, which it never stored")
        self._push(self._memo[index])

    def global_name(self) -> None:
        name = f"{self._line()}.{self._line()}"
        if name not in self._allowed:
            if (reason := self._unsupported(name)) is not None:
                raise CheckpointError(f"{reason}; nothing was run")
            raise UnsafeCheckpointError(
                f"its pickle asks for {name!r:.200}, which is not part of a detection checkpoint; "
                "nothing was run. Do not use this file, or save the model again from a source you trust"
            )
        self._push(self._allowed[name])

    def reduce(self) -> None:
        arguments, function = self._pop(), self._pop()
        if not isinstance(function, AllowedGlobal) or not isinstance(arguments, tuple):
            raise UnsafeCheckpointError(f"its pickle calls a {type(function).__name__}; nothing was run")
        # A set and a size are copies of their arguments.
        copied = arguments[0] if arguments else None
        self._spend(_CALL_BYTES + _PAIR_BYTES * (len(copied) if isinstance(copied, list | tuple) else 0))
        self._push(function.call(arguments))

    def new_object(self) -> None:
        arguments, kind = self._pop(), self._pop()
        if not isinstance(kind, AllowedGlobal) or kind.make is not None or not isinstance(arguments, tuple):
            name = kind.name if isinstance(kind, AllowedGlobal) else type(kind).__name__
            raise UnsafeCheckpointError(f"its pickle makes an instance of {name}; nothing was run")
        self._left_bytes -= _CALL_BYTES
        self._push(Stub(kind.name, arguments))

    def build(self) -> None:
        state = self._pop()
        target = self._stack[-1] if self._stack else None
        if isinstance(target, dict):
            return  # An ordered dictionary's own attributes (torch: layer versions) carry no weights.
        if not isinstance(target, Stub):
            raise UnsafeCheckpointError(
                f"its pickle sets attributes of a {type(target).__name__}; nothing was run"
            )
        self._spend(_OBJECT_BYTES + _PAIR_BYTES * (len(state) if isinstance(state, dict) else 1))
        # Some classes (numpy.dtype) have a state of another kind; it is kept but not used.
        target.state.update(state if isinstance(state, dict) else {"__setstate__": state})

    def persistent_id(self) -> None:
        identity = self._pop()
        if not isinstance(identity, tuple):
            raise CheckpointError("its pickle names a storage by something else than a tuple")
        self._push(self._persistent(identity))


def _text(data: bytes) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        raise CheckpointError("its pickle holds a text that is not UTF-8") from None


_HANDLERS: dict[bytes, Callable[[_Machine], None]] = {
    b"\x80": _Machine.proto,
    b"(": _Machine.mark,
    b"N": lambda machine: machine._push(None),
    b"\x88": lambda machine: machine._push(True),
    b"\x89": lambda machine: machine._push(False),
    b"K": lambda machine: machine._push(machine._unsigned(1)),
    b"M": lambda machine: machine._make(machine._unsigned(2)),
    b"J": _Machine.integer,
    b"\x8a": _Machine.long,
    b"G": _Machine.real,
    b"X": _Machine.text,
    b")": lambda machine: machine._push(()),
    b"t": _Machine.tuple_to_mark,
    b"\x85": lambda machine: machine.tuple_of(1),
    b"\x86": lambda machine: machine.tuple_of(2),
    b"\x87": lambda machine: machine.tuple_of(3),
    b"]": lambda machine: machine._make([]),
    b"a": _Machine.append,
    b"e": _Machine.appends,
    b"}": lambda machine: machine._make({}),
    b"s": _Machine.set_item,
    b"u": _Machine.set_items,
    b"q": lambda machine: machine.put(1),
    b"r": lambda machine: machine.put(4),
    b"h": lambda machine: machine.get(1),
    b"j": lambda machine: machine.get(4),
    b"c": _Machine.global_name,
    b"R": _Machine.reduce,
    b"\x81": _Machine.new_object,
    b"b": _Machine.build,
    b"Q": _Machine.persistent_id,
}
