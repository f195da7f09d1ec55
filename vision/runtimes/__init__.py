"""What computes the network: torch, ONNX Runtime, OpenVINO or TensorRT behind one small contract."""
