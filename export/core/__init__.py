"""Helpers of the export stages: strict TOML tables, settings, and the cache of finished stages."""
