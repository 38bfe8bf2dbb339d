"""Data shared by a run's threads: frames, encoded frames, pose history, semantic state, reasoning text."""
