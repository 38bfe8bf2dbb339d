"""The model's prompt, the rules of its reasoning text, and what an instruction keeps between generations."""
