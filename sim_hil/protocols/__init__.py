"""Front ends of `edge-hil`, one for each protocol, and what they share: interface, camera stream, fault socket."""
