"""Drives a collection, and writes down how it stands."""
