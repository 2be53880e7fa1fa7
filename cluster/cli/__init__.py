"""The command line `adaafford`."""
