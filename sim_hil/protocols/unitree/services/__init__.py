"""Services of the simulated Go2, one module each: what a request does and what is answered."""
