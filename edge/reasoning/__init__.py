"""The model's prompt, the rules of its reasoning text, and the memory of an instruction between generations."""
