"""Certified registration of point sets and maps."""
