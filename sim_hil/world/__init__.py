"""Textured meshes of a scene: shell, objects by kind, and what walls hide."""
