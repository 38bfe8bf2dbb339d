"""Textured meshes of a scene: shell, objects by kind, and visibility behind walls."""
