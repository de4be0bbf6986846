"""The flight plan: its files, the geometry of its lines, and the state of each line as it is flown."""
