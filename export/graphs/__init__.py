"""Writes the network's ONNX graphs node by node."""
