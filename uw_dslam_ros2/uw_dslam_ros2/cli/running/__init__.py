"""What long commands do: bags to a merge, maps to a map, processes that are watched."""
