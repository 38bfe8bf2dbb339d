"""From recorded drives to training samples: anchors, batches, cached tokens and semantic states."""
