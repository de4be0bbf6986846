"""Scanners: how a head emits its pulses, how it measures their echoes, and the packets that it sends."""
