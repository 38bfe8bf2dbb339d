"""MAVLink protocol of the Carter, as a rover on UDP."""
