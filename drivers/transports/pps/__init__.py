"""Edges of pulse-per-second signals: the kernel's PPS API, a serial line's DCD, a fixed schedule."""
