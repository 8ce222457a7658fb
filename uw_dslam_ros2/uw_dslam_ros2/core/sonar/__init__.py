"""Polar sonar images to detections."""
