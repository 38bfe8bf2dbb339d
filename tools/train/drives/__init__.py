"""Recorded drives on disk: one file a drive, data sets, windows and future poses."""
