"""Simulated Go2: body, legs, gait and sport controller."""
