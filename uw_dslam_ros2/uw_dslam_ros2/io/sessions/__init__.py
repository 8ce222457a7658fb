"""A merge on disk: sessions with checksums, and what links keep."""
