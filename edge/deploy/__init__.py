"""`edge-install`: prepares a device for the runner: releases, DDS binding, engines, systemd units and their checks."""
