"""`edge-calib`: replaces modelled numbers of a device or a robot by measured ones."""

import edge  # noqa: F401 - before ONNX Runtime: it turns its telemetry off
