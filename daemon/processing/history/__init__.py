"""`swath history`: the parameters of all calibrations of an aircraft over time."""
