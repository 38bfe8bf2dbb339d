"""Tests of what the bridge asks of its operating system: files, log and watchdog."""
