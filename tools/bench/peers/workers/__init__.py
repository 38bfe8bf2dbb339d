"""One worker process for each runtime that is compared."""
