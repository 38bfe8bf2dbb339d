"""Environment of one episode: observations, outcome, metrics, reward, Gymnasium interface."""
