"""Front ends of `edge-hil`, one per protocol, and their shared parts: interface, camera stream, fault socket."""
