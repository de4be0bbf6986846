"""NMEA 0183 sentences of GNSS receivers."""
