"""Inference runtimes: torch, ONNX Runtime, OpenVINO or TensorRT behind one interface."""
