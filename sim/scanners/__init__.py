"""Scanners: how a head sends its pulses, what it measures of their echoes."""
