"""CAN protocol of the Carter: frames with end-to-end protection, node, buses, bus faults."""
