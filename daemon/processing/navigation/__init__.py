"""From logs to a navigated trajectory."""
