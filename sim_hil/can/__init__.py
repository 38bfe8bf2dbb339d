"""Old name of `sim_hil.protocols.can`; kept for commands that name it."""
