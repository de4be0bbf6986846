"""CAN signals that a DBC file describes."""
