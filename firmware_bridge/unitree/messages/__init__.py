"""Messages of a Go2 as data: IDL types, ids, checksum, and its checked state."""
