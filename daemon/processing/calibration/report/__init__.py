"""The calibration's report: pages, pictures, tables."""
