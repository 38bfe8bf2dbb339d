"""Helpers of every export stage: strict TOML tables, settings, the cache of finished stages."""
