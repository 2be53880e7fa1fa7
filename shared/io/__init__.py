"""Files, JSON and text that nobody vouches for, and private folders."""
