"""Sources of pulse-per-second edges: the kernel's PPS API, a serial line's DCD, and a file of edges."""
