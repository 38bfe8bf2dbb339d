"""Electric power: what the device draws, what it may draw, and how reasoning is shed to stay below it."""
