"""Simulated places, sonar images, noisy navigation and recordings."""
