"""The calibration record in the terms of ISO/TS 19159-2 and OGC: content, values, dictionary."""
