"""Parts of the virtual aircraft's GNSS receiver: its errors, its messages, its serial line."""
