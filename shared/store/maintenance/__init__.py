"""What looks after a store: verify, repair, compact, merge, export, migrate, info."""
