"""What the sonar mapper does with topics, services and the order of stamps."""
