"""Tokenizers of the two model sizes."""
