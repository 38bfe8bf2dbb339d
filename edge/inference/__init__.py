"""Runs the exported graphs: sessions and engines, the policy of a tick, the language model of a generation."""
