"""Policies that drive an episode: exported models, baselines, the expert, external servers."""
