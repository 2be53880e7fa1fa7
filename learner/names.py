"""What the files are called that others than the learner look for, without the weight of what writes them."""

METRICS_FILE = "metrics.jsonl"
"""Of a training: one line a validation."""
PUBLISHED_FILE = "published.json"
"""Of a learner beside collection: which version each of its policies became."""
