"""Trimble and Applanix: GSOF reports and POS groups."""
