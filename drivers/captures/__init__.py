"""Recordings that others made (pcap, candump, serial bytes): where their units come from."""
