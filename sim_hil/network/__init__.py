"""Network shim: reproducible loss, delay, duplication, reordering, partition and rate limits on any link."""
