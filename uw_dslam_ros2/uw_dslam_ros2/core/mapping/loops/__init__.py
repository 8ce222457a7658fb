"""Where a vehicle comes back to: matches of its own submaps, and the poses that follow."""
