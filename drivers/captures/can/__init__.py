"""Logs of CAN buses that other programs write: candump, ASC, BLF, TRC and MF4."""
