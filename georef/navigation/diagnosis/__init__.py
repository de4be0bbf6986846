"""What innovations say of a flight's installation and timing."""
