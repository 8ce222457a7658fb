"""Registration of two occupancy maps: search, evidence, verdict."""
