"""Results of episodes: records, the run directory, summaries, report, video."""
