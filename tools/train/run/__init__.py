"""Folder and processes of a training run: stage jobs, ranks, checkpoints, optimiser, weights between stages."""
