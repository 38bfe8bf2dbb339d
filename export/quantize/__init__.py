"""Rounding of weights and activations: precision by layer, layouts, and its effect on the torch model."""
