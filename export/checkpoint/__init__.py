"""Reading other people's checkpoints (and ours) into the network, with every tensor accounted for."""
