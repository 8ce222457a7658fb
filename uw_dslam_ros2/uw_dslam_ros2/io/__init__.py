"""Files: bags, maps, settings, sessions, public data sets."""
