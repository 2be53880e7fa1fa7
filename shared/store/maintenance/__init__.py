"""What looks after a store: verify, repair, compact, merge, export, info."""
