"""Procedural objects in PartNet-Mobility's layout, so that a fresh machine needs no data set."""
