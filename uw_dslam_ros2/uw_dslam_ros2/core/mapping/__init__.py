"""Occupancy mapping, SLAM inside one vehicle, submaps."""
