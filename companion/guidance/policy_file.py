"""Policy files: an ONNX network from an observation to an action, with a description of both.

The network has one input, (1, observations) float32, and one output, (1, actions) float32, both in the units
of the description, which is JSON in the file's metadata under `KEY`. `companion learn train` writes them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from companion.guidance.policy_network import Network, NetworkError, read_network
from vision.file_kinds import explained, open_file

_Format = Literal["mavlink-companion.policy.v1"]
FORMAT: _Format = "mavlink-companion.policy.v1"
KEY = "mavlink_companion_policy"
Activation = Literal["", "Tanh", "Relu"]
_OPSET, _IR_VERSION = 17, 8
POLICIES_FOLDER = Path(__file__).parent / "policies"
# How long a step takes is limited by `Network.check`.
LARGEST_BYTES = 4_000_000

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Text = Annotated[str, Field(min_length=1, max_length=60)]


class PolicyError(ValueError):
    """A policy file cannot be used. The message is one line with the file's name."""


class Quantity(BaseModel):
    """One number: of the observation with the range visited in training, of the action with its limits."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: _Text
    unit: Annotated[str, Field(max_length=20)]
    low: _Finite
    high: _Finite

    @model_validator(mode="after")
    def _check(self) -> Quantity:
        if self.low >= self.high:
            raise ValueError(f"low must be less than high, got {self.low:g} and {self.high:g}")
        return self

    @property
    def allowed(self) -> str:
        """The range in words."""
        return f"{self.low:g} to {self.high:g}{' ' + self.unit if self.unit else ''}"


class PolicyDescription(BaseModel):
    """What a policy observes and commands, in the order of its input and its output.

    Attributes:
        environment: id of the environment it was trained in.
        rate_hz: steps a second.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: _Format = FORMAT
    environment: _Text
    rate_hz: Annotated[float, Field(ge=1.0, le=100.0)]
    observation: Annotated[tuple[Quantity, ...], Field(min_length=1, max_length=100)]
    action: Annotated[tuple[Quantity, ...], Field(min_length=1, max_length=20)]

    @model_validator(mode="after")
    def _check(self) -> PolicyDescription:
        for names in ([each.name for each in self.observation], [each.name for each in self.action]):
            if len(set(names)) != len(names):
                raise ValueError(f"a name occurs twice: {', '.join(names)}")
        return self


class LoadedPolicy:
    """A policy that is ready to be stepped.

    Attributes:
        name: of the file, without suffix.
    """

    def __init__(self, name: str, description: PolicyDescription, network: Network) -> None:
        self.name, self.description, self._network = name, description, network

    def act(self, observation: Sequence[float]) -> list[float]:
        """The action for an observation, both in the order and the units of the description; not clipped."""
        return [float(value) for value in self._network.compute(np.array([observation], np.float32))[0]]


def find_policy(name: str) -> Path:
    """Resolve a policy's name: a path, or the name of one bundled with this package.

    Raises:
        PolicyError: not found.
    """
    path = Path(name)
    bundled = {file.stem: file for file in sorted(POLICIES_FOLDER.glob("*.onnx"))}
    try:
        if path.is_file():
            return path
    except OSError as error:
        raise PolicyError(f"invalid policy name {name[:80]!r}: {error.strerror or error}") from error
    except ValueError as error:
        raise PolicyError(f"invalid policy name {name[:80]!r}: {error}") from error
    if name in bundled:
        return bundled[name]
    raise PolicyError(
        f"policy {name[:80]!r} not found: no such file in {Path.cwd()}; "
        f"bundled policies: {', '.join(bundled) or 'none'}"
    )


def load_policy(path: Path) -> LoadedPolicy:
    """Load and check a policy file.

    Raises:
        PolicyError: it cannot be read, has no description or another layout than described.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_BYTES:
            raise PolicyError(f"{path}: a policy has at most {LARGEST_BYTES} bytes, this file has {size}")
        with open_file(path) as file:
            content = file.read()
    except OSError as error:
        raise PolicyError(f"{path}: cannot be read: {error}") from error
    try:
        network = read_network(content)
    except NetworkError as error:
        raise PolicyError(explained(path, f"{path}: no usable ONNX file: {error}")) from error
    text = network.metadata.get(KEY)
    if text is None:
        raise PolicyError(
            f"{path}: has no description of its observation and action (metadata {KEY}); "
            "train it with `companion learn train --policy`"
        )
    try:
        description = PolicyDescription.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "it"
        raise PolicyError(f"{path}: its description cannot be used: {where}: {first['msg']}") from error
    for what, ports, quantities in (
        ("input", network.inputs, description.observation),
        ("output", network.outputs, description.action),
    ):
        found = ", ".join(f"{'float32' if port.is_float32 else 'other'}{port.shape}" for port in ports)
        shape = [1, len(quantities)]
        if [(port.is_float32, port.shape) for port in ports] != [(True, shape)]:
            raise PolicyError(f"{path}: expected one {what} float32{shape}, as it is described, got {found}")
    try:
        network.check()
    except NetworkError as error:
        raise PolicyError(f"{path}: {error}") from error
    policy = LoadedPolicy(path.stem, description, network)
    action = policy.act([(each.low + each.high) / 2 for each in description.observation])
    if not all(map(math.isfinite, action)):
        raise PolicyError(f"{path}: its action is no number ({action}); train it again")
    return policy


@dataclass(frozen=True, slots=True)
class Layer:
    """One fully connected layer: `activation(weight @ x + bias)`, weight (outputs, inputs)."""

    weight: NDArray[np.float64]
    bias: NDArray[np.float64]
    activation: Activation = ""


def write_policy(path: Path, description: PolicyDescription, layers: Sequence[Layer]) -> None:
    """Write a policy file. The layers take and give the units of the description."""
    from onnx import TensorProto, helper, numpy_helper, save

    nodes, tensors, value = [], [], "observation"
    for index, layer in enumerate(layers):
        names = [f"weight{index}", f"bias{index}"]
        for name, array in zip(names, (layer.weight, layer.bias), strict=True):
            tensors.append(numpy_helper.from_array(np.asarray(array, np.float32), name))
        result = "action" if index == len(layers) - 1 and not layer.activation else f"sum{index}"
        nodes.append(helper.make_node("Gemm", [value, *names], [result], transB=1))
        value = result
        if layer.activation:
            value = "action" if index == len(layers) - 1 else f"value{index}"
            nodes.append(helper.make_node(layer.activation, [result], [value]))
    ports = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, len(quantities)])
        for name, quantities in (("observation", description.observation), ("action", description.action))
    ]
    graph = helper.make_graph(nodes, "policy", ports[:1], ports[1:], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
    helper.set_model_props(model, {KEY: description.model_dump_json()})
    save(model, str(path))
