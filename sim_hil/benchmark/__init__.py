"""The DynaNav benchmark: `edge-bench` and its parts."""
