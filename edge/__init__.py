"""The part of tic-vla-edge that runs on the robot."""

import os

# From 1.29 on ONNX Runtime keeps a telemetry database, and knows where to send it, unless told not to before it is
# imported. That has no business on a robot, nor in a workshop; every program of ours imports this package first.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
