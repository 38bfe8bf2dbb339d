"""`edge-install`: prepares a device for the runner: engines, systemd units and their checks."""
