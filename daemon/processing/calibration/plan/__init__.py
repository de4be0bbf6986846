"""`swath plan-calibration`."""
