"""Several vehicles survey one place: in memory, as recordings, through the mapper, over a link."""
