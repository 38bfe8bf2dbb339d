"""Folder and processes of a training run: stage jobs, ranks, the training loop, weights between stages."""
