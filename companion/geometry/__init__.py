"""Vehicle-independent geometry: fences, formations, lists of points, geodesy."""
