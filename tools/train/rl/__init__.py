"""Stage 3: reinforcement learning (PPO) with asynchronous reasoning."""
