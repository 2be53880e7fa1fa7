"""What of a raw scan is the object, and which of its parts move."""
