"""Rounding of weights and activations: precision by layer, layouts, and the rounded PyTorch model."""
