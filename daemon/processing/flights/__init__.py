"""Which logs and which trajectory belong together."""
