"""`python -m tools.findings`: whether the paper's findings hold for a set of models."""
