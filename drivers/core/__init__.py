"""Framing, checksums and the parser contract that every protocol file shares."""
