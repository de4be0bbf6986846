"""SREP, the project's own protocol of ranges and encoder readings."""
