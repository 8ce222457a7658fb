"""A view of the map in the browser: what is shown, tiles of maps, and the server."""
