"""Distributed sonar mapping with several underwater vehicles."""

__version__ = "0.1.0"
