"""One episode as a world to act in: observations, outcome, metrics, reward, Gymnasium."""
