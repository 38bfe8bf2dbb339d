"""Measures of a soak, and their judgement against a budget."""
