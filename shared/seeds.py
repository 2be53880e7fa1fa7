"""Random generators that depend on the campaign's seed and on what is drawn, not on workers or time."""

import zlib

import numpy as np


def seed_sequence(seed: int, purpose: str, *indices: int) -> np.random.SeedSequence:
    """A seed sequence for one named purpose.

    Args:
        seed: the campaign's seed, non-negative.
        purpose: what is drawn, such as "dynamics" or "actions"; two purposes never share a stream.
        indices: which one, such as the rollout's and the interaction's number, each in [0, 2**32).
    """
    return np.random.SeedSequence(seed, spawn_key=(zlib.crc32(purpose.encode()), *indices))


def generator(seed: int, purpose: str, *indices: int) -> np.random.Generator:
    """A separate NumPy generator for `purpose` and `indices` (see `seed_sequence`)."""
    return np.random.Generator(np.random.PCG64(seed_sequence(seed, purpose, *indices)))


def torch_seed(seed: int, purpose: str, *indices: int) -> int:
    """A 63-bit seed for a `torch.Generator`, by the same rule."""
    low, high = seed_sequence(seed, purpose, *indices).generate_state(2, np.uint32)
    return int(low) | (int(high & 0x7FFFFFFF) << 32)
