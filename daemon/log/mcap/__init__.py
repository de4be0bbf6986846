"""The MCAP container format: chunks, records, index and writer."""
