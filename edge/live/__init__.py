"""The live view: what a run does, in a browser or Foxglove, served by a process of its own."""
