"""Bad networks on purpose: loss, delay, duplication, reordering, partition and rate limits on any link, repeatably."""
