"""Robot, bridge and runner as real processes, and the ground truth of their run."""
