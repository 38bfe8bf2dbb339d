"""Commands of the project itself: demo, training, fault injection, findings, benchmarks."""

import edge  # noqa: F401 - before ONNX Runtime: it turns its telemetry off
