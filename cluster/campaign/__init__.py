"""The alternation of collection and training as stages over one folder, and what it will cost."""
