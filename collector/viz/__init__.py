"""Pictures of objects and of trials."""
