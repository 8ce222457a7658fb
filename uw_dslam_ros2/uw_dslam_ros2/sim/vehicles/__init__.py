"""Vehicles under way: routes, motion, and what their instruments say."""
