"""Which answers hold against all others, and which vehicles are set aside."""
