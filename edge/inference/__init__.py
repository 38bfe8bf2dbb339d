"""Runs the exported graphs: sessions, engines, the policy of a tick, the language model of a generation."""
