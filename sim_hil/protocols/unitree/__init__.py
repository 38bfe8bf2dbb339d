"""The Go2 on Unitree's DDS protocol: state topics, camera process, and faults of each."""
