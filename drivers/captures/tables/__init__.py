"""Reader of tables of records, CSV and Parquet: columns named with their unit become units of protocol ``records``."""
