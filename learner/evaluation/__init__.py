"""Tables of methods, adaptation curves and their intervals."""
