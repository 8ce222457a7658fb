"""What two maps say about each other at a pose, and the verdict on it."""
