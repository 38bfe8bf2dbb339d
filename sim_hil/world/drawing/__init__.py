"""Tools to draw with: meshes, textures, printed pictures, surfaces, and the stage that shows them."""
