"""Building a TensorRT plan from an ONNX file, on the GPU that will run it (TensorRT 10's API)."""

from __future__ import annotations

import logging
from pathlib import Path

from vision.runtimes.base import RuntimeUnusableError, required
from vision.runtimes.exported import INPUT

logger = logging.getLogger(__name__)

# Memory for trying layer implementations. Tuned for boards that share memory with the processor.
_WORKSPACE_BYTES = 1 << 30


def build_plan(onnx_path: Path, *, largest_side: int, stride: int, half: bool = True) -> bytes:
    """The serialised engine, in float16 where the GPU supports it; takes minutes on a small board.

    Args:
        largest_side: of an input; the plan is tuned for three quarters of it in height.
        half: allow float16.

    Raises:
        RuntimeMissingError: TensorRT is not installed.
        RuntimeUnusableError: it rejects the network, with TensorRT's message.
    """
    tensorrt = required("tensorrt")
    trt_logger = tensorrt.Logger(tensorrt.Logger.ERROR)
    builder = tensorrt.Builder(trt_logger)
    definition = builder.create_network(0)
    parser = tensorrt.OnnxParser(definition, trt_logger)
    if not parser.parse_from_file(str(onnx_path)):
        errors = "; ".join(str(parser.get_error(index)) for index in range(parser.num_errors))
        raise RuntimeUnusableError(f"{onnx_path}: TensorRT cannot read it: {errors[:500]}")
    config = builder.create_builder_config()
    config.set_memory_pool_limit(tensorrt.MemoryPoolType.WORKSPACE, _WORKSPACE_BYTES)
    if half and builder.platform_has_fast_fp16:
        config.set_flag(tensorrt.BuilderFlag.FP16)
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
