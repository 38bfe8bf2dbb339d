"""What a training run is made of: the recipe, the configuration of every stage, and named variants."""
