"""`python -m tools.findings`: tests the paper's findings on a set of models."""
