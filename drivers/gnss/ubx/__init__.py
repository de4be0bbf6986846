"""u-blox UBX messages."""
