"""What this package adds to adaafford, one module each."""
