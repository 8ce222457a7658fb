"""What is said of each sensor, by itself and by the echoes."""
