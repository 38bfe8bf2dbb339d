"""What can be made to go wrong on the robot's side of the wire, and when it did. Loaded by `edge-hil --faults` only."""
