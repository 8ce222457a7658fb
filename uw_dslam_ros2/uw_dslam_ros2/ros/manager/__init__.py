"""What the map queue manager does with topics, services, servers and its session."""
