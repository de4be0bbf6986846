"""Files of surveyed points: text of any maker's layout, GeoPackage, shapefile; their CRS and their place."""
