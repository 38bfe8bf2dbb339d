"""The DynaNav benchmark: episodes as data, how they are run, and what is measured."""
