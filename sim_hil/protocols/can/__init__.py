"""The Carter on CAN: frames with end-to-end protection, node, buses, and bus faults."""
