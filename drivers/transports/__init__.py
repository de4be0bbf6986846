"""Serial, CAN, UDP, PPS and capture files: bytes with host time, no meaning."""
