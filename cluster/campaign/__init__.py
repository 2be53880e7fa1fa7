"""The alternation of collection and training as stages of one run folder, and its cost estimate."""
