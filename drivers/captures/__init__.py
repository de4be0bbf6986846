"""Readers of recordings that other programs made: pcap, candump and serial bytes."""
