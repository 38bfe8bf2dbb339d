"""Unitree protocol of the Go2 over DDS: services, state topics, camera process, and their faults."""
