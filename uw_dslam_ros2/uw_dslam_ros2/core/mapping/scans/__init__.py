"""A ping is matched with the last stretch of the path."""
