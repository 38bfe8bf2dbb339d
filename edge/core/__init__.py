"""Helpers that all of `edge` uses: geometry, deadlines, statistics, exit codes, device facts."""
