"""The global map, its frame, and when walls were last seen."""
