"""The coverage of a plan, and its picture."""
