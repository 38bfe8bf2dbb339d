"""The CAN bus of a wheeled base described by a DBC file, as the bridge speaks it."""
