"""Pinch profiles: they show what lies between the fingers, and turn and mirror as the gripper does."""

import numpy as np
import pytest
import torch

from learner.data.sampling import flip_frames, turn_frames
from shared.geometry import gripper_rotation
from shared.networks.actions import FRAME_WIDTH, swapped_fingers, turned_over
from shared.networks.layers import ActionEncoder
from shared.networks.network_config import NETWORKS, NetworkConfig
from shared.pinch import BINS, PROFILE_WIDTH, REACH_M, pinch_profiles
from shared.types import Float, Float32
from tests.support.small_networks import TINY

MIDDLE = BINS // 2
FRAME = np.array([[1, 0, 0, 0, 0, 1]], np.float32)
"""Approaches along x, forward is up; so the closing axis is -y."""
ORIGIN = np.zeros(3, np.float32)


def panel(left: float, right: float, x: float = 0.0) -> Float32:
    """Points every 5 mm of a wall that the gripper approaches, from `left` to `right` along the closing axis."""
    across, up = np.meshgrid(np.arange(left, right, 0.005), np.arange(-0.2, 0.2, 0.005))
    return np.stack([np.full(across.size, x), -across.ravel(), up.ravel()], axis=1).astype(np.float32)


def parts(profiles: Float32) -> tuple[Float32, Float32, float]:
    """Surface, whether there is one, and what stands out, of one profile."""
    assert profiles.shape == (1, PROFILE_WIDTH)
    assert profiles.dtype == np.float32
    return profiles[0, :BINS], profiles[0, BINS : 2 * BINS], float(profiles[0, -1])


def random_frames(count: int, rng: np.random.Generator) -> Float32:
    rotations = [gripper_rotation(d / np.linalg.norm(d), rng.normal(size=3)) for d in rng.normal(size=(count, 3))]
    return np.array([np.concatenate([r[:, 2], r[:, 0]]) for r in rotations], np.float32)


def test_a_flat_panel_fills_all_bins_at_the_height_of_p() -> None:
    surface, there, standing_out = parts(pinch_profiles(panel(-0.3, 0.3), ORIGIN, FRAME))
    assert (surface == 0).all()
    assert (there == 1).all()
    assert standing_out == 0


def test_an_edge_between_the_fingers_ends_the_surface_there() -> None:
    surface, there, _ = parts(pinch_profiles(panel(-0.3, 0.012), ORIGIN, FRAME))
    assert there.tolist() == [1] * (MIDDLE + 2) + [0] * (BINS - MIDDLE - 2)
    assert (surface == np.where(there, 0, 1)).all()


def test_a_step_is_seen_at_its_depth() -> None:
    surface, there, _ = parts(pinch_profiles(np.concatenate([panel(-0.3, 0.0), panel(0, 0.3, 0.02)]), ORIGIN, FRAME))
    assert surface[:MIDDLE] == pytest.approx(np.zeros(MIDDLE))
    assert surface[MIDDLE + 1 :] == pytest.approx(np.full(MIDDLE, 0.4), abs=1e-6)
    assert (there == 1).all()


def test_a_bar_narrower_than_the_opening_stands_between_two_gaps() -> None:
    bar = panel(-0.012, 0.0125)
    surface, there, _ = parts(pinch_profiles(np.concatenate([bar, panel(-0.3, 0.3, 0.2)]), ORIGIN, FRAME))
    assert np.flatnonzero(there).tolist() == [MIDDLE - 1, MIDDLE, MIDDLE + 1]
    assert (surface[there == 0] == 1).all()
    # Turned by 90 deg about the approach, the fingers lie along the bar.
    along = np.array([[1, 0, 0, 0, 1, 0]], np.float32)
    assert (parts(pinch_profiles(bar, ORIGIN, along))[1] == 1).all()


def test_what_stands_out_beside_the_fingers_counts_apart() -> None:
    knob = np.array([[-0.06, 0.05, 0.025]], np.float32)
    surface, _, standing_out = parts(pinch_profiles(np.concatenate([panel(-0.3, 0.3), knob]), ORIGIN, FRAME))
    assert (surface == 0).all()
    assert standing_out == pytest.approx(0.6)


@pytest.mark.parametrize("dense", [np.zeros((0, 3)), np.full((5, 3), 3 * REACH_M)])
def test_where_nothing_is_near_there_is_no_surface(dense: Float) -> None:
    surface, there, standing_out = parts(pinch_profiles(dense.astype(np.float32), ORIGIN, FRAME))
    assert (surface == 1).all()
    assert not there.any()
    assert standing_out == 0


def test_profiles_of_many_actions_are_those_of_each() -> None:
    rng = np.random.default_rng(0)
    dense, frames = rng.uniform(-0.2, 0.2, (4000, 3)).astype(np.float32), random_frames(100, rng)
    together = pinch_profiles(dense, ORIGIN, frames)
    assert together.shape == (100, PROFILE_WIDTH)
    for number in range(0, 100, 9):
        np.testing.assert_array_equal(pinch_profiles(dense, ORIGIN, frames[number][None])[0], together[number])


def scene(seed: int) -> tuple[Float32, Float32, Float32]:
    """A cloud, a point of it, and some frames; no coordinate is at the border of a bin."""
    rng = np.random.default_rng(seed)
    dense = rng.uniform(-0.15, 0.15, (1500, 3)).astype(np.float32)
    return dense, dense[0], random_frames(20, rng)


def told(dense: Float32, point: Float32, frames: Float32) -> torch.Tensor:
    return torch.from_numpy(np.concatenate([frames, pinch_profiles(dense, point, frames)], axis=1))


def nearly_all_equal(one: torch.Tensor, other: torch.Tensor) -> None:
    """Rounding may move a point over the border of a bin."""
    close = torch.isclose(one, other, atol=1e-4)
    assert close.float().mean() > 0.99


@pytest.mark.parametrize("seed", range(3))
def test_turning_the_gripper_over_reverses_the_profile(seed: int) -> None:
    dense, point, frames = scene(seed)
    over = frames * np.array([1, 1, 1, -1, -1, -1], np.float32)
    nearly_all_equal(turned_over(told(dense, point, frames)), told(dense, point, over))
    assert torch.equal(turned_over(turned_over(told(dense, point, frames))), told(dense, point, frames))


@pytest.mark.parametrize("mirrored", [False, True])
def test_augmented_profiles_are_those_of_the_augmented_scene(mirrored: bool) -> None:
    dense, point, frames = scene(4)
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]], np.float32)
    turn = turn @ np.diag([1, -1 if mirrored else 1, 1]).astype(np.float32)
    turned = (frames.reshape(-1, 2, 3) @ turn.T).reshape(-1, 6)
    expected = told((dense @ turn.T).astype(np.float32), turn @ point, turned)
    seen = turn_frames(torch.from_numpy(turn)[None], told(dense, point, frames)[None])
    nearly_all_equal(seen[0], expected)
    flipped = flip_frames(torch.tensor([True]), seen)
    assert torch.equal(flipped[0], turned_over(seen[0]))
    assert torch.equal(flip_frames(torch.tensor([False]), seen), seen)


def test_frames_without_a_profile_have_no_fingers_to_swap() -> None:
    frames = torch.from_numpy(FRAME)
    assert torch.equal(swapped_fingers(frames), frames)
    assert torch.equal(turned_over(frames), torch.tensor([[1.0, 0, 0, 0, 0, -1.0]]))


@pytest.mark.parametrize("profile", [False, True])
def test_with_roll_symmetry_an_action_turned_over_is_encoded_alike(profile: bool) -> None:
    config = TINY.model_copy(update={"pinch_profile": profile, "roll_symmetry": True})
    encoder = ActionEncoder(config)
    dense, point, frames = scene(5)
    given = told(dense, point, frames)[:, : FRAME_WIDTH + PROFILE_WIDTH * profile]
    features, places = torch.randn(len(given), config.point_width), torch.randn(len(given), 3)
    torch.testing.assert_close(encoder(features, places, given), encoder(features, places, turned_over(given)))
    plain = ActionEncoder(config.model_copy(update={"roll_symmetry": False}))
    plain.load_state_dict(encoder.state_dict())
    assert not torch.allclose(plain(features, places, given), plain(features, places, turned_over(given)))


def test_the_encoder_is_told_the_profile() -> None:
    encoder = ActionEncoder(TINY.model_copy(update={"pinch_profile": True}))
    given = told(*scene(6))
    features, places = torch.randn(len(given), TINY.point_width), torch.randn(len(given), 3)
    other = given.clone()
    other[:, FRAME_WIDTH + 3] += 0.5
    assert not torch.allclose(encoder(features, places, given), encoder(features, places, other))


@pytest.mark.parametrize("config", [*NETWORKS.values(), TINY])
def test_configurations_that_lack_the_profile_are_written_as_before(config: NetworkConfig) -> None:
    assert not config.pinch_profile
    assert not config.roll_symmetry
    assert not {"pinch_profile", "roll_symmetry"} & config.as_document().keys()
    assert NetworkConfig.model_validate(config.as_document()) == config
