"""The calibration record of ISO/TS 19159-2 and OGC terms: content, values, dictionary."""
