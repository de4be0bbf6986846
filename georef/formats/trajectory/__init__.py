"""Read trajectory files: their common columns, CSV, and the choice of a reader by content."""
