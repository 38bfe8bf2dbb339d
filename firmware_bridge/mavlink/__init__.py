"""The MAVLink protocol of rovers with PX4 or ArduPilot, as the bridge speaks it."""
