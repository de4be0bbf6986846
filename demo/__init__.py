"""The demonstration: real recordings and the virtual aircraft, played into a real recorder."""
