"""Public recordings, turned into bags."""
