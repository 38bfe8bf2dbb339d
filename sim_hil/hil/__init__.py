"""`edge-hil`: a simulated robot in real time behind its maker's protocol."""
