"""Training: expert data, the encoder, the language model, imitation under delay and reinforcement (`edge-train`)."""
