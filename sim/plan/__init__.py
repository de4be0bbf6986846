"""The plan of a flight: its tables, presets and errors."""
