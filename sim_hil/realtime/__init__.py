"""Robot, bridge and runner as real processes, started, watched and ended, and the ground truth of their run."""
