"""The workers of a collection: Ray actors, their job queue, retries and the session that they live in."""
