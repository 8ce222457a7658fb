"""Which submaps to register next."""
