"""`edge-hil`: the simulated robot on the other end of a real protocol, in real time."""
