"""Distributed sonar mapping with several underwater vehicles."""
