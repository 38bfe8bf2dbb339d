"""Feeds random and mutated input into each backend's decoder: nothing may raise, nothing may move the robot."""
