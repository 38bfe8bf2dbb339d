"""Training samples from recorded drives: anchors, batches, cached visual tokens and semantic states."""
