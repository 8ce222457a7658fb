"""Layers to packets and back over a shared channel that loses some."""
