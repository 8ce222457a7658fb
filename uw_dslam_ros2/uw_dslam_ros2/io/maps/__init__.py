"""Maps as files: map_server's form, walls as lines, who saw what."""
