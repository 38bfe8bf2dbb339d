"""`edge-export`: from a trained network to verified artifacts for a target."""

import edge  # noqa: F401 - before ONNX Runtime: it turns its telemetry off
