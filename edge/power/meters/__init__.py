"""Reads power, temperature and throttling of a device: one module for each kind of meter."""
