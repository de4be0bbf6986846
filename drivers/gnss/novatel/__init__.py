"""NovAtel OEM logs, binary and ASCII."""
