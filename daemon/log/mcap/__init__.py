"""The MCAP container: chunks, records, index, writer."""
