"""The chart: all pings once more, at the poses of the settled graph."""
