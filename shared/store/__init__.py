"""The store: immutable shards, each complete if and only if its manifest is there."""
