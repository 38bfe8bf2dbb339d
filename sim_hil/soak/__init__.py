"""`edge-soak`: drives for hours in real time with random faults, and judges what it has measured."""
