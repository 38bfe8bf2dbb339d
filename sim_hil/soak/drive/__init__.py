"""One leg of a soak: tasks, faults and samples in one running stack."""
