"""Monitors: each looks at one input of the runner and says in every step what is wrong with it now, and nothing else.

All are pure: `step(…, now_ns)` has no clock, thread or I/O. What a finding does to the robot is for the supervisor.
"""
