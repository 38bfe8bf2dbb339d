"""Loads checkpoints of several formats into the network and accounts for every tensor."""
