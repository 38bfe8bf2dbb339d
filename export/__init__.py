"""`edge-export`: exports a trained network as verified artifacts for a target."""

import edge  # noqa: F401 - before ONNX Runtime: it turns its telemetry off
