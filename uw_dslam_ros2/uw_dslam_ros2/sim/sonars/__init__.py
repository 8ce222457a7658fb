"""What sonars see: fans, sonars that turn, points in space."""
