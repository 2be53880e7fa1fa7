"""A store as arrays, and the batches that training takes from them."""
