"""The bridge's rules, configuration and messages, without a clock, a socket or DDS."""
