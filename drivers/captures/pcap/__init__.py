"""Captures of network and CAN traffic in pcap and pcapng: containers, link layers, IP, TCP, and the writer."""
