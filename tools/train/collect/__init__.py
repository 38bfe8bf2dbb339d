"""Records drives: the expert's, rounds of DAgger, and tours for the language model."""
