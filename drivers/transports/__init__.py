"""Serial, CAN, UDP, NTRIP and PPS inputs: bytes or edges with their times, no meaning."""
