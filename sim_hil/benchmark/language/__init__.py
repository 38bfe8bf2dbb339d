"""Routes through a scene as instructions in words, and back."""
