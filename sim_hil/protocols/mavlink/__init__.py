"""The Carter as a MAVLink rover on UDP."""
