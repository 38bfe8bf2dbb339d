"""The bridge's rules and what they work on, without a clock, a socket or DDS."""
