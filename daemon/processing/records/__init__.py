"""Records of a log as NumPy tables, each row with its GPS time and the sigma of that time."""
