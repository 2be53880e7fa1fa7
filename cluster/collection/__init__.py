"""The driver of a collection, and its status."""
