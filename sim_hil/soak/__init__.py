"""`edge-soak`: drive for hours in real time with random faults, and judge the measurements against a budget."""
