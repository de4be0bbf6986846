"""Parts of the virtual aircraft's GNSS receiver: its errors, its messages and its serial line."""
