"""Benchmarks of collection: each measures what it claims in the same run as what it compares with."""
