"""Recorded drives on disk: one file per drive, data sets and future poses."""
