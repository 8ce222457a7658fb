"""One branch and bound with its fields, bounds and sweeps: terms in, proven poses out."""
