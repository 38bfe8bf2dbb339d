"""Services of the simulated Go2: handling of requests, one module per service."""
