"""The shared weights in every peer's own format."""
