"""Replay of a log: its units, and the wires that they are sent over."""
