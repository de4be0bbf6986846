"""CAN buses: SocketCAN, python-can's adapters, and the bit rate of an interface."""
