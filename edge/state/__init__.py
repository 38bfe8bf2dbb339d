"""What the threads of a run share: camera frames, encoded frames, pose history, the semantic state, the reasoning
text."""
