"""The TIC-VLA network in PyTorch: vision encoder, language model, action expert, and its configuration."""
