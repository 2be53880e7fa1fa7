"""How records become bytes, and hostile bytes records: Parquet tables, Zarr clouds, checksummed JSON."""
