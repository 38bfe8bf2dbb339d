"""Files of an artifact directory, verified before anything in them is opened."""
