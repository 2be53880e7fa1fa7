"""The training loop, its losses, checkpoints and hardware."""
