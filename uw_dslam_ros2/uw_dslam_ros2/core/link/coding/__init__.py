"""A submap in few bytes: layers, each of which decodes with those before it."""
