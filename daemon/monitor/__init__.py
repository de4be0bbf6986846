"""What a recorder says of itself, shown."""
