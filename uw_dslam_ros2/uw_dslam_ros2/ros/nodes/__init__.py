"""The four nodes, one file each."""
