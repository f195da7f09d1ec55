"""Files as other exporters write them, made here: their metadata, names, shapes and layouts."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from vision.runtimes.base import required
from vision.yolo.architecture import YoloModel

ULTRALYTICS = {
    "author": "Ultralytics",
    "version": "8.4.190",
    "license": "AGPL-3.0 License (https://ultralytics.com/license)",
    "stride": 32,
    "task": "detect",
    "batch": 1,
    "channels": 3,
    "end2end": False,
}


def stated(names: Sequence[str], size: tuple[int, int], **others: Any) -> dict[str, Any]:
    """Metadata of an Ultralytics export; ONNX holds the `str` of each value."""
    table = {"names": dict(enumerate(names)), "imgsz": list(size), "args": {"nms": None, "dynamic": False}}
    return {**ULTRALYTICS, **table, **others}


def constant_onnx(
    path: Path,
    outputs: Mapping[str, NDArray[Any]],
    *,
    size: tuple[int | str, int | str] = (64, 96),
    metadata: Mapping[str, Any] | None = None,
    red_at: tuple[int, int, int] | None = None,
    input_name: str = "images",
    input_type: str = "FLOAT",
    takes_size: bool = False,
) -> Path:
    """An ONNX file whose outputs are these, whatever the image.

    Args:
        red_at: add the input's value at (channel, row, column) to every number of the first output.
        takes_size: with the second input of RT-DETR's and D-FINE's exports.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    kind = getattr(TensorProto, input_type)
    inputs = [helper.make_tensor_value_info(input_name, kind, [1, 3, *size])]
    if takes_size:
        inputs.append(helper.make_tensor_value_info("orig_target_sizes", TensorProto.INT64, [1, 2]))
    nodes, made = [], []
    for index, (name, value) in enumerate(outputs.items()):
        at = red_at if index == 0 and red_at is not None else None
        constants = {f"{name}_value": value}
        nodes.append(
            helper.make_node("Identity", [f"{name}_value"], [name if at is None else f"{name}_plain"])
        )
        if at is not None:
            constants |= {
                f"{name}_from": np.array([0, *at]),
                f"{name}_to": np.array([1, *(position + 1 for position in at)]),
            }
            nodes += [
                helper.make_node("Slice", [input_name, f"{name}_from", f"{name}_to"], [f"{name}_pixel"]),
                helper.make_node("Squeeze", [f"{name}_pixel"], [f"{name}_number"]),
                helper.make_node("Add", [f"{name}_plain", f"{name}_number"], [name]),
            ]
        nodes += [
            helper.make_node("Constant", [], [key], value=numpy_helper.from_array(constant, key))
            for key, constant in constants.items()
        ]
        made.append(
            helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(value.dtype), value.shape)
        )
    order = {"Constant": 0}
    nodes.sort(key=lambda node: order.get(node.op_type, 1))
    graph = helper.make_graph(nodes, "made", inputs, made)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    for key, text in (metadata or {}).items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, str(text)
    onnx.save(model, str(path))
    return path


class Decoded(nn.Module):
    """A YOLO network as Ultralytics exports it: (1, 3, H, W) RGB in 0..1 → (1, 4 + classes, cells)."""

    def __init__(self, model: YoloModel) -> None:
        super().__init__()
        self.model = model.fuse()

    def forward(self, image: Tensor) -> Tensor:
        found = []
        bins = self.model.reg_max
        for level, stride in zip(self.model(image), self.model.strides, strict=True):
            sides, logits = level.split((4 * bins, level.shape[1] - 4 * bins), dim=1)
            height, width = level.shape[2], level.shape[3]
            weights = sides.reshape(1, 4, bins, height * width).softmax(2)
            left, top, right, bottom = (weights * torch.arange(bins).view(1, 1, bins, 1)).sum(2)[0]
            y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
            x, y = x.flatten(), y.flatten()
            box = torch.stack((x + (right - left) / 2, y + (bottom - top) / 2, left + right, top + bottom))
            found.append(torch.cat((box[None] * stride, logits.flatten(2).sigmoid()), dim=1))
        return torch.cat(found, dim=2)


def ultralytics_onnx(path: Path, model: YoloModel, size: tuple[int, int], *, dynamic: bool = False) -> Path:
    import onnx

    axes = {"images": {2: "height", 3: "width"}, "output0": {2: "anchors"}} if dynamic else None
    with torch.no_grad():
        torch.onnx.export(
            Decoded(model),
            (torch.zeros(1, 3, *size),),
            str(path),
            input_names=["images"],
            output_names=["output0"],
            dynamic_axes=axes,
            opset_version=17,
            dynamo=False,
        )
    made = onnx.load(str(path))
    for key, text in stated(model.class_names, size).items():
        entry = made.metadata_props.add()
        entry.key, entry.value = key, str(text)
    onnx.save(made, str(path))
    return path


class Selected(nn.Module):
    """With torchvision's NMS, as Ultralytics exports with `nms=True`."""

    def __init__(self, model: YoloModel) -> None:
        super().__init__()
        self.decoded = Decoded(model)

    def forward(self, image: Tensor) -> Tensor:
        found = self.decoded(image)[0].T
        scores, classes = found[:, 4:].max(1)
        kept: Tensor = torch.ops.torchvision.nms(found[:, :4], scores, 0.7)
        return torch.cat((found[:, :4], scores[:, None], classes[:, None].float()), 1)[kept][None]


def ultralytics_torchscript(
    path: Path, model: YoloModel, size: tuple[int, int], *, nms: bool = False, **others: Any
) -> Path:
    trace: Any = torch.jit.trace
    module = Selected(model) if nms else Decoded(model)
    with torch.no_grad():
        module = trace(module, torch.zeros(1, 3, *size), check_trace=False)
    text = json.dumps(stated(model.class_names, size, **others))
    torch.jit.save(module, str(path), _extra_files={"config.txt": text})
    return path


def ultralytics_openvino(folder: Path, onnx_path: Path, names: Sequence[str], size: tuple[int, int]) -> Path:
    """A folder with `NAME.xml`, `NAME.bin` and `metadata.yaml`."""
    import yaml

    openvino = required("openvino")
    folder.mkdir()
    openvino.save_model(
        openvino.convert_model(str(onnx_path)), str(folder / "net.xml"), compress_to_fp16=False
    )
    (folder / "metadata.yaml").write_text(yaml.safe_dump(stated(names, size), sort_keys=False))
    return folder
