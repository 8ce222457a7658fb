"""Places seen from above: outlines, what lies in them, what moves, what could be seen."""
