"""The virtual aircraft. It shares no mathematics with georef or calib: an error must not agree with itself."""
