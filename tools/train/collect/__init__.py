"""Recording of drives: the expert's, DAgger rounds, and tours for the language model."""
