"""Stage 1: supervised fine-tuning of the language model."""
