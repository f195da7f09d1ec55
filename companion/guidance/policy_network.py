"""Small networks from ONNX files, computed with numpy: in the loop of guidance nothing large is loaded.

ONNX Runtime takes 0.1 to 2 s to import, in which no setpoint could be sent. Field numbers are those of
onnx.proto (https://onnx.ai/onnx/repo-docs/IR.html), the encoding that of Protocol Buffers.
"""

from __future__ import annotations

import math
import struct
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float32]
_Shape = tuple[int, ...]
_Fields = defaultdict[int, list[int | bytes]]
_FLOAT32 = 1
_EXTERNAL = 14
# One step of guidance waits for the network: within these limits about 1 ms of a core.
LARGEST_WIDTH = 1024
LARGEST_NODES = 100
LARGEST_MULTIPLICATIONS = 1_000_000
# Reading it takes at most some 50 ms: fields of a message and of weights, bytes of all else.
_LARGEST_FIELDS, _WEIGHTS_FIELDS, _LARGEST_REST_BYTES = 1000, 20, 200_000


class NetworkError(ValueError):
    """The content is no ONNX file, or of a network that is not computed here. The message is one line."""


def _sigmoid(x: _Floats) -> _Floats:
    return np.asarray(1.0 / (1.0 + np.exp(-x)), np.float32)


# The function and how many inputs it takes.
OPERATORS: dict[str, tuple[Callable[..., _Floats], int]] = {
    "Add": (np.add, 2),
    "Div": (np.divide, 2),
    "MatMul": (np.matmul, 2),
    "Mul": (np.multiply, 2),
    "Relu": (lambda x: np.maximum(x, np.float32(0.0)), 1),
    "Sigmoid": (_sigmoid, 1),
    "Sub": (np.subtract, 2),
    "Tanh": (np.tanh, 1),
}


@dataclass(frozen=True, slots=True)
class _Port:
    """An input or an output; `shape` holds None where the file names no number."""

    name: str
    shape: list[int | None]
    is_float32: bool


@dataclass(frozen=True, slots=True)
class _Node:
    """One operation: its function, the names of its inputs and of its output.

    `transposed`: of the second factor of a matrix product; None: computed number by number.
    """

    function: Callable[..., _Floats]
    inputs: list[str]
    output: str
    transposed: bool | None

    def shape(self, shapes: list[_Shape]) -> tuple[_Shape, int]:
        """The shape that it computes from these, and the multiplications. Raises ValueError."""
        if self.transposed is None:
            computed = np.broadcast_shapes(*shapes)
            return computed, math.prod(computed)
        first, second, *bias = shapes
        if len(first) != 2 or len(second) != 2:
            raise ValueError(f"a product of {list(first)} and {list(second)}")
        second = second[::-1] if self.transposed else second
        if first[1] != second[0]:
            raise ValueError(f"a product of {list(first)} and {list(second)}")
        return np.broadcast_shapes((first[0], second[1]), *bias), first[0] * first[1] * second[1]


@dataclass(frozen=True, slots=True)
class Network:
    """A network with its weights.

    Attributes:
        metadata: texts of the file, by key.
        inputs, outputs: without the weights.
        weights: by name.
        nodes: in the order of computation.
    """

    metadata: dict[str, str]
    inputs: list[_Port]
    outputs: list[_Port]
    weights: dict[str, _Floats]
    nodes: list[_Node]

    def check(self) -> None:
        """Find the shape of every value, without computing it.

        Raises:
            NetworkError: weights, nodes and ports do not fit each other, a value is not of shape (1, n), or
                the network is too large to be computed in a step of guidance.
        """
        shapes: dict[str, _Shape] = {name: weight.shape for name, weight in self.weights.items()}
        shapes[self.inputs[0].name] = tuple(size or 0 for size in self.inputs[0].shape)
        if len(self.nodes) > LARGEST_NODES:
            raise NetworkError(f"it has {len(self.nodes)} operators, at most {LARGEST_NODES} are computed")
        total = 0
        for node in self.nodes:
            try:
                shape, multiplications = node.shape([shapes[name] for name in node.inputs])
            except KeyError as error:
                raise NetworkError(f"nothing computes {error}") from error
            except ValueError as error:
                raise NetworkError(f"{node.output} cannot be computed: {error}") from error
            if len(shape) != 2 or shape[0] != 1 or not 1 <= shape[1] <= LARGEST_WIDTH:
                raise NetworkError(
                    f"{node.output} is of shape {list(shape)}, expected [1, n] with n up to {LARGEST_WIDTH}"
                )
            shapes[node.output] = shape
            total += multiplications
        if total > LARGEST_MULTIPLICATIONS:
            raise NetworkError(f"a step takes {total} multiplications, at most {LARGEST_MULTIPLICATIONS} fit")
        last = self.outputs[0]
        if last.name not in shapes:
            raise NetworkError(f"nothing computes {last.name!r}")
        if list(shapes[last.name]) != last.shape:
            raise NetworkError(f"it computes {list(shapes[last.name])}, its output is {last.shape}")

    def compute(self, value: _Floats) -> _Floats:
        """The first output for the first input, both (1, numbers), of a network that was checked."""
        values = {**self.weights, self.inputs[0].name: value}
        # Infinite and undefined results are found by the caller.
        with np.errstate(all="ignore"):
            for node in self.nodes:
                values[node.output] = node.function(*[values[name] for name in node.inputs])
        return values[self.outputs[0].name]


def read_network(content: bytes) -> Network:
    """Read an ONNX file whose weights are inside it. Raises NetworkError."""
    try:
        model = _fields(content)
        if not model[7]:
            raise NetworkError("it holds no graph")
        graph = _fields(_bytes(model[7][-1]))
        rest = sum(len(_bytes(each)) for each in (*graph[1], *graph[11], *graph[12], *model[14]))
        if rest > _LARGEST_REST_BYTES:
            raise NetworkError(
                f"it has {rest} bytes beside its weights, at most {_LARGEST_REST_BYTES} are read"
            )
        weights = dict(_tensor(_bytes(each)) for each in graph[5])
        ports = [[_port(_bytes(each)) for each in graph[key]] for key in (11, 12)]
        pairs = [_fields(_bytes(each)) for each in model[14]]
        return Network(
            {_text(pair, 1): _text(pair, 2) for pair in pairs},
            [port for port in ports[0] if port.name not in weights],
            ports[1],
            weights,
            [_node(_fields(_bytes(each))) for each in graph[1]],
        )
    except NetworkError:
        raise
    except (IndexError, OverflowError, ValueError, struct.error) as error:
        raise NetworkError(f"it is damaged: {error}") from error


def _node(node: _Fields) -> _Node:
    kind, names = _text(node, 4), [_bytes(name).decode() for name in node[1]]
    attributes = {_text(each, 1): each for each in (_fields(_bytes(attribute)) for attribute in node[5])}
    given = f" with {', '.join(attributes)}" if attributes else ""
    computed, inputs = OPERATORS.get(kind, (None, 0))
    transposed = False if kind == "MatMul" else None
    if kind == "Gemm" and attributes.keys() <= {"alpha", "beta", "transB"}:
        alpha, beta = (_number(attributes[key], 2) if key in attributes else 1.0 for key in ("alpha", "beta"))
        transposed = "transB" in attributes and _number(attributes["transB"], 3) != 0
        computed, inputs, attributes = _gemm(alpha, beta, transposed), min(max(len(names), 2), 3), {}
    if computed is None or attributes or node[7]:
        raise NetworkError(f"operator {kind}{given} is not computed; known: Gemm, {', '.join(OPERATORS)}")
    if len(names) != inputs:
        raise NetworkError(f"operator {kind} has {len(names)} inputs, expected {inputs}")
    return _Node(computed, names, _text(node, 2), transposed)


def _gemm(alpha: float, beta: float, transposed: bool) -> Callable[..., _Floats]:
    def computed(x: _Floats, weight: _Floats, bias: _Floats | None = None) -> _Floats:
        product = np.float32(alpha) * (x @ (weight.T if transposed else weight))
        return product if bias is None else product + np.float32(beta) * bias

    return computed


def _tensor(content: bytes) -> tuple[str, _Floats]:
    tensor = _fields(content, _WEIGHTS_FIELDS)
    name = _text(tensor, 8)
    if _number(tensor, 2) != _FLOAT32 or _number(tensor, _EXTERNAL):
        raise NetworkError(f"weights {name!r} must be float32 and in the file")
    raw = _bytes(tensor[9][0]) if tensor[9] else b"".join(map(_bytes, tensor[4]))
    shape = _numbers(tensor[1])
    if len(raw) != 4 * np.prod(shape, dtype=object):
        raise NetworkError(f"weights {name!r} have {len(raw)} bytes, which is not {shape} in float32")
    return name, np.frombuffer(raw, "<f4").reshape(shape)


def _port(content: bytes) -> _Port:
    port = _fields(content)
    tensor = _fields(b"".join(map(_bytes, _fields(_bytes(port[2][0]))[1])))
    dimensions = [_fields(_bytes(each)) for shape in tensor[2] for each in _fields(_bytes(shape))[1]]
    shape = [int(_number(each, 1)) if each[1] else None for each in dimensions]
    return _Port(_text(port, 1), shape, _number(tensor, 1) == _FLOAT32)


def _numbers(values: Sequence[int | bytes]) -> list[int]:
    """The integers of a shape, each alone or many packed."""
    numbers: list[int] = []
    for value in values:
        if isinstance(value, int):
            numbers.append(value)
            continue
        at = 0
        while at < len(value):
            number, at = _varint(value, at)
            numbers.append(number)
            if len(numbers) > 2:
                break
    if len(numbers) > 2:
        raise NetworkError("weights must have at most 2 dimensions")
    return numbers


def _number(fields: _Fields, key: int) -> float:
    """The newest number of a field; 0: not given."""
    value = fields[key][-1] if fields[key] else 0
    return struct.unpack("<f", value)[0] if isinstance(value, bytes) else value


def _text(fields: _Fields, key: int) -> str:
    return _bytes(fields[key][-1]).decode() if fields[key] else ""


def _bytes(value: int | bytes) -> bytes:
    if isinstance(value, int):
        raise NetworkError("it is damaged: a number where a message is expected")
    return value


def _fields(content: bytes, limit: int = _LARGEST_FIELDS) -> _Fields:
    """The fields of one message, by number. Fixed-size numbers stay bytes."""
    fields: _Fields = defaultdict(list)
    at = count = 0
    while at < len(content):
        key, at = _varint(content, at)
        kind, count = key & 7, count + 1
        if count > limit:
            raise NetworkError(f"a message of it has more than {limit} fields")
        if kind == 0:
            number, at = _varint(content, at)
            fields[key >> 3].append(number)
            continue
        if kind == 2:
            size, at = _varint(content, at)
        elif kind in (1, 5):
            size = 8 if kind == 1 else 4
        else:
            raise NetworkError(f"it is damaged: unknown kind of field {kind}")
        if at + size > len(content):
            raise NetworkError(f"it is damaged: {at + size - len(content)} bytes are missing at the end")
        fields[key >> 3].append(content[at : at + size])
        at += size
    return fields


def _varint(content: bytes, at: int) -> tuple[int, int]:
    """The integer at a place, and the place after it. Raises IndexError at the end."""
    number = shift = 0
    while True:
        byte = content[at]
        number |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return number, at
        if shift > 63:
            raise NetworkError("it is damaged: an integer of more than 64 bits")
