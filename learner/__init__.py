"""Offline learning from a store alone: prior, AAP, AIP, metrics. Runs with neither Ray nor SAPIEN installed."""
