"""Processes of the fault harness: robot, bridge, runner or its stand-in, sniffer and second commander."""
