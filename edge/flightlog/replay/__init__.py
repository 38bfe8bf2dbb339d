"""`edge-replay`: runs the policy again on a flight log and compares the outputs with the recorded ones."""
