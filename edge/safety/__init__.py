"""Decides what the robot may do: monitors report findings, the supervisor answers each by the fault table."""
