"""Scripts that measure what the documentation states: `python -m benchmarks.NAME`, from the root of the repository."""
