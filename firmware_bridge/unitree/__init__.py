"""The Unitree protocol of a Go2 over DDS: requests, calls, state and camera."""
