"""Registration of two point sets: search, evidence, verdict."""
