"""The demonstration: real recordings played into a real recorder."""
