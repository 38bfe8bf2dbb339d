"""One run: the control and reasoning threads, and the session that arms, drives and ends them."""
