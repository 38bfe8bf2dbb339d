"""The flight log: MCAP files written by a thread of its own, read back and cleaned up."""
