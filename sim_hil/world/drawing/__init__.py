"""Drawing tools: meshes, textures, prints, surfaces, and the stage that shows them."""
