import edge  # noqa: F401 - before ONNX Runtime: it turns its telemetry off
