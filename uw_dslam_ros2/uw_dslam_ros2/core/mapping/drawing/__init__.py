"""Echoes and free water become the cells of a grid."""
