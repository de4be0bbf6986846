"""Loops over single returns, compiled; what they compute is written in `georef.sensor_model` and `georef.beams`."""
