"""Compiled loops over single returns; `georef.sensor_model` and `georef.beams` describe their computation."""
