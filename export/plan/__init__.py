"""Plan of a target: time, memory and power of a model on a device, modelled or measured."""
