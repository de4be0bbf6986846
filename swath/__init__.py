"""Airborne laser scanning, from the sensors' wires to the point cloud.

``swath.georef`` georeferences, ``swath.calib`` calibrates, ``swath.drivers`` reads devices, ``swath.daemon`` records
and holds the command line, ``swath.sim`` flies a virtual aircraft.
"""

__version__ = "0.1.0"
