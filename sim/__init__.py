"""The virtual aircraft; it shares no mathematics with georef or calib, so that an error there cannot cancel here."""
