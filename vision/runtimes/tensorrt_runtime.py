"""TensorRT, on an NVIDIA GPU (the API of 10 and 11; the CUDA runtime through NVIDIA's `cuda-python`)."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.extras import install_command
from vision.file_kinds import open_file
from vision.runtimes.base import Precision, RuntimeMissingError, RuntimeName, RuntimeUnusableError, required
from vision.runtimes.exported import INPUT, ExportedFacts, split_facts
from vision.yolo.level_outputs import Head, LevelOutput, Product

logger = logging.getLogger(__name__)

# Memory for trying layer implementations. Tuned for boards that share memory with the processor.
_WORKSPACE_BYTES = 1 << 30
_CUDA = "cuda.bindings.runtime"


def build_plan(onnx_path: Path, *, largest_side: int, stride: int) -> bytes:
    """The serialised engine, in the file's precision; takes minutes on a small board.

    Args:
        largest_side: of an input; the plan is tuned for three quarters of it in height.

    Raises:
        RuntimeMissingError: TensorRT is not installed.
        RuntimeUnusableError: it rejects the network, with TensorRT's message.
    """
    tensorrt = required("tensorrt")
    trt_logger = tensorrt.Logger(tensorrt.Logger.ERROR)
    builder = tensorrt.Builder(trt_logger)
    # TensorRT 11 has only strongly typed networks; by its migration guide the flag stays, without effect.
    strongly_typed = 1 << int(tensorrt.NetworkDefinitionCreationFlag.STRONGLY_TYPED)
    definition = builder.create_network(strongly_typed)
    parser = tensorrt.OnnxParser(definition, trt_logger)
    if not parser.parse_from_file(str(onnx_path)):
        errors = "; ".join(str(parser.get_error(index)) for index in range(parser.num_errors))
        raise RuntimeUnusableError(f"{onnx_path}: TensorRT cannot read it: {errors[:500]}")
    config = builder.create_builder_config()
    config.set_memory_pool_limit(tensorrt.MemoryPoolType.WORKSPACE, _WORKSPACE_BYTES)
    profile = builder.create_optimization_profile()
    usual = (1, max(stride, largest_side * 3 // 4 // stride * stride), largest_side, 3)
    profile.set_shape(INPUT, (1, stride, stride, 3), usual, (1, largest_side, largest_side, 3))
    config.add_optimization_profile(profile)
    logger.info("building a TensorRT plan for %s; this takes minutes and is done once", onnx_path.name)
    plan = builder.build_serialized_network(definition, config)
    if plan is None:
        raise RuntimeUnusableError(
            f"{onnx_path}: TensorRT cannot build a plan; see its log on standard error"
        )
    return bytes(plan)


class TensorRtRuntime:
    """An `.engine` written by `export`, on the first GPU. See `base.Runtime`.

    Plans are bound to the GPU and the TensorRT version that built them, and to the precision they were built
    in.
    """

    product: Product = staticmethod(np.matmul)
    name: RuntimeName = "tensorrt"

    def __init__(
        self,
        path: Path,
        head: Head | None = None,
        *,
        precision: Precision = "auto",
        threads: int | None = None,
    ) -> None:
        if precision not in ("auto", "float16"):
            raise RuntimeUnusableError(f"{path}: a TensorRT plan computes in float16, not in {precision}")
        tensorrt = required("tensorrt", also=_CUDA)
        facts, plan = _read(path)
        self.head = facts.head() if head is None else head
        self._cuda = _Cuda()
        # Kept alive: the engine refers to it.
        self._runtime = tensorrt.Runtime(tensorrt.Logger(tensorrt.Logger.ERROR))
        engine = self._runtime.deserialize_cuda_engine(plan)
        if engine is None:
            raise RuntimeUnusableError(
                f"{path}: TensorRT {tensorrt.__version__} cannot load this plan on this GPU; plans are bound "
                "to both: export it again here with `companion models export`"
            )
        self._engine = engine
        self._context = engine.create_execution_context()
        names = [engine.get_tensor_name(index) for index in range(engine.num_io_tensors)]
        for name in names:
            found = engine.get_tensor_dtype(name)
            expected = tensorrt.DataType.UINT8 if name == INPUT else tensorrt.DataType.FLOAT
            if found != expected:
                raise RuntimeUnusableError(
                    f"{path}: {name} of this plan is {found}, expected {expected}: export it again with "
                    "`companion models export`"
                )
        kinds = {"sides": 0, "neck": 0, "classes": 1, "features": 2}
        self._outputs = sorted(
            (name for name in names if name != INPUT),
            key=lambda name: (int(name.rpartition("_")[2]), kinds[name.rpartition("_")[0]]),
        )
        self._size: tuple[int, int] | None = None
        self._host_outputs: list[NDArray[np.float32]] = []
        self._device: list[tuple[int, int]] = []
        self.precision, self.precision_reason = "float16", "precision of the plan"
        # One thread waits for the GPU.
        self.threads = 1

    def prepare(self, height: int, width: int) -> None:
        for _ in range(2):
            self.infer(np.zeros((height, width, 3), np.uint8))

    def infer(self, image_bgr: NDArray[np.uint8]) -> list[LevelOutput]:
        size = (image_bgr.shape[0], image_bgr.shape[1])
        if size != self._size:
            self._allocate(size)
        device_input, *outputs = self._device
        self._cuda.to_device(device_input[0], image_bgr)
        if not self._context.execute_async_v3(self._cuda.stream):
            raise RuntimeUnusableError("TensorRT could not run the network; see its log on standard error")
        for (pointer, _), host_output in zip(outputs, self._host_outputs, strict=True):
            self._cuda.to_host(host_output, pointer)
        self._cuda.wait()
        levels = [level[0] for level in self._host_outputs]
        return self.head.levels(levels)

    def _allocate(self, size: tuple[int, int]) -> None:
        """Allocate host and device memory for one input size."""
        self._size = None
        for pointer, _ in self._device:
            self._cuda.free(pointer)
        self._device, self._host_outputs = [], []
        if not self._context.set_input_shape(INPUT, (1, *size, 3)):
            raise RuntimeUnusableError(
                f"this TensorRT plan does not accept {size[1]}x{size[0]}; export it again with a larger size"
            )
        self._bind(INPUT, size[0] * size[1] * 3)
        for name in self._outputs:
            shape = tuple(self._context.get_tensor_shape(name))
            host_output = np.empty(shape, np.float32)
            self._host_outputs.append(host_output)
            self._bind(name, host_output.nbytes)
        self._size = size

    def _bind(self, name: str, size_bytes: int) -> None:
        pointer = self._cuda.allocate(size_bytes)
        self._device.append((pointer, size_bytes))
        self._context.set_tensor_address(name, pointer)


class _Cuda:
    """The required calls of the CUDA runtime, on one stream; a failure raises with the error's name."""

    def __init__(self) -> None:
        import importlib

        try:
            self._api: Any = importlib.import_module(_CUDA)
        except ImportError as error:
            raise RuntimeMissingError(
                f"{_CUDA} cannot be loaded ({error}): {install_command(_CUDA)}"
            ) from error
        (self.stream,) = self._checked(self._api.cudaStreamCreate())

    def allocate(self, size_bytes: int) -> int:
        (pointer,) = self._checked(self._api.cudaMalloc(size_bytes))
        return int(pointer)

    def free(self, pointer: int) -> None:
        self._checked(self._api.cudaFree(pointer))

    def to_device(self, pointer: int, array: NDArray[Any]) -> None:
        kind = self._api.cudaMemcpyKind.cudaMemcpyHostToDevice
        self._checked(self._api.cudaMemcpyAsync(pointer, array.ctypes.data, array.nbytes, kind, self.stream))

    def to_host(self, array: NDArray[Any], pointer: int) -> None:
        kind = self._api.cudaMemcpyKind.cudaMemcpyDeviceToHost
        self._checked(self._api.cudaMemcpyAsync(array.ctypes.data, pointer, array.nbytes, kind, self.stream))

    def wait(self) -> None:
        self._checked(self._api.cudaStreamSynchronize(self.stream))

    def _checked(self, answer: tuple[Any, ...]) -> tuple[Any, ...]:
        error, *rest = answer
        if int(error) != 0:
            raise RuntimeUnusableError(f"CUDA: {error}")
        return tuple(rest)


def tensorrt_facts(path: Path) -> ExportedFacts:
    """Read the metadata of an exported `.engine`; needs no TensorRT."""
    return _read(path)[0]


def _read(path: Path) -> tuple[ExportedFacts, memoryview]:
    try:
        with open_file(path) as file:
            content = file.read()
    except OSError as error:
        raise RuntimeUnusableError(f"{path}: cannot be read: {error.strerror}") from error
    return split_facts(content, path)
