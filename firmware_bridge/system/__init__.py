"""What the bridge uses of the operating system: output files, log lines and the service manager."""
