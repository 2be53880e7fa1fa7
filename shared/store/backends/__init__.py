"""Storage backends of a store: a folder or a bucket, behind one interface."""
