"""Laws of the networks: what they may and may not depend on."""

import weakref
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial import cKDTree

from shared.networks.aap import Aap
from shared.networks.actions import (
    DETAIL_WIDTH,
    MOMENT_SCALE,
    TOLD_KINDS,
    action_inputs,
    geodesic_distance,
    in_gripper,
    orthonormal_frames,
    outcome_details,
    outcome_inputs,
    outcome_width,
    without_details,
)
from shared.networks.layers import Head, point_features
from shared.networks.network_config import NETWORKS, NetworkConfig
from shared.networks.pointnet2 import CloudBatch, Grouping, PointNet2, group_cloud, nearest_points, surroundings
from shared.networks.prior import Prior
from shared.types import OutcomeKind
from tests.support.small_networks import TINY


def clouds(count: int, points: int = 64, config: NetworkConfig = TINY, seed: int = 0) -> CloudBatch:
    rng = np.random.default_rng(seed)
    stacked = [rng.uniform(-1, 1, (points, 3)).astype(np.float32) for _ in range(count)]
    return CloudBatch.of(stacked, [group_cloud(cloud, config) for cloud in stacked])


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_grouping_finds_the_nearest_within_the_radius(name: str) -> None:
    config = NETWORKS[name].model_copy(update={"neighbours": 5})
    points = np.random.default_rng(1).uniform(-0.3, 0.3, (200, 3)).astype(np.float32)
    found = group_cloud(points, config).neighbours[0]
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    for centre, row in enumerate(found):
        inside = np.flatnonzero(distances[centre] <= config.radii[0])
        nearest = inside[np.argsort(distances[centre][inside])][:5]
        assert set(row) == set(nearest)
        assert row[0] == centre


@pytest.mark.parametrize("points", [1, 2, 5, 23])
def test_clouds_smaller_than_the_first_level_are_encoded(points: int) -> None:
    batch = clouds(2, points)
    encoder = PointNet2(TINY)
    everywhere = torch.arange(points)
    assert torch.isfinite(encoder.at(encoder(batch), torch.ones_like(everywhere), everywhere)).all()


@pytest.mark.parametrize("bad", [np.full((10, 3), np.nan, np.float32), np.zeros((0, 3), np.float32)])
def test_a_cloud_without_finite_points_is_refused(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="a cloud must hold"):
        group_cloud(bad, TINY)


def test_a_feature_depends_on_its_own_cloud_and_not_on_what_else_is_asked() -> None:
    batch, encoder = clouds(3), PointNet2(TINY)
    together = encoder.at(encoder(batch), torch.tensor([0, 1, 2, 1]), torch.tensor([5, 6, 7, 8]))
    alone = encoder.at(encoder(batch.select(torch.tensor([1]))), torch.tensor([0]), torch.tensor([6]))
    torch.testing.assert_close(together[1:2], alone, rtol=1e-4, atol=1e-5)


def test_published_widths_are_the_published_ones() -> None:
    config = NETWORKS["published"]
    batch = clouds(2, 1200, config)
    encoder = PointNet2(config)
    encoded = encoder(batch)
    assert [tuple(x.shape[1:]) for x in batch.neighbours] == [(1024, 32), (256, 32), (64, 32), (16, 32)]
    assert encoder.at(encoded, torch.tensor([0, 1]), torch.tensor([3, 1199])).shape == (2, 128)
    assert sum(isinstance(m, torch.nn.BatchNorm1d) for m in encoder.modules()) == 12 + 9


def test_head_is_one_layer_on_the_concatenation() -> None:
    torch.manual_seed(0)
    head = Head((3, 4), 2, TINY)
    a, b = torch.randn(5, 3), torch.randn(5, 4)
    whole = torch.cat([a, b], -1) @ torch.cat(list(head.inputs), 1).T + head.bias
    torch.testing.assert_close(head(a, b), head.output(torch.nn.functional.leaky_relu(whole)))
    assert head(a[:, None], b[None]).shape == (5, 5, 2)


@given(st.integers(0, 2**31 - 1))
@settings(max_examples=100)
def test_any_six_numbers_give_a_rotation(seed: int) -> None:
    raw = torch.randn(4, 6, generator=torch.Generator().manual_seed(seed))
    raw[1] = 0.0
    raw[2, 3:] = -2.0 * raw[2, :3]
    raw[3, :3] = torch.tensor([0.0, 0.0, 1.0])
    frames = orthonormal_frames(raw)
    gram = torch.stack([frames[:, :3], frames[:, 3:]], 1)
    torch.testing.assert_close(gram @ gram.mT, torch.eye(2).expand(4, 2, 2), rtol=0, atol=1e-5)


def test_geodesic_distance_is_the_angle() -> None:
    frame = torch.tensor([0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    angle = 0.7
    turned = torch.tensor([0.0, 0.0, 1.0, np.cos(angle), np.sin(angle), 0.0])
    assert geodesic_distance(frame, turned) == pytest.approx(angle, abs=1e-4)
    assert geodesic_distance(frame, frame) == pytest.approx(0.0, abs=2e-3)


def test_action_features_hold_the_moment() -> None:
    point, frame = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    inputs = action_inputs(point, frame, TINY)
    torch.testing.assert_close(inputs[9:], MOMENT_SCALE * torch.tensor([0.0, 0.0, 1.0]))
    plain = TINY.model_copy(update={"action_features": False})
    assert torch.equal(action_inputs(point, frame, plain), frame)


def test_surroundings_are_the_nearest_points_and_turn_with_the_gripper() -> None:
    batch = clouds(2, points=40)
    cloud, point = torch.tensor([0, 1, 1]), torch.tensor([3, 3, 7])
    centres = batch.points[cloud, point]
    offsets = surroundings(batch.points, cloud, centres, 6)
    assert torch.equal(offsets[:, 0], torch.zeros(3, 3))
    for found, which, centre in zip(offsets, cloud, centres, strict=True):
        distances = (batch.points[which] - centre).norm(dim=-1).sort().values
        torch.testing.assert_close(found.norm(dim=-1), distances[:6])
    frames, turn = orthonormal_frames(torch.randn(3, 6)), torch.linalg.qr(torch.randn(3, 3)).Q
    turn = turn * torch.linalg.det(turn)
    turned = torch.cat([frames[:, :3] @ turn.T, frames[:, 3:] @ turn.T], dim=-1)
    torch.testing.assert_close(in_gripper(offsets @ turn.T, turned), in_gripper(offsets, frames))
    # A point ahead along the approach comes last of the three, one along forward first.
    ahead = in_gripper(torch.stack([frames[:, :3], frames[:, 3:]], dim=1), frames)
    torch.testing.assert_close(ahead, torch.tensor([[0.0, 0, 1], [1, 0, 0]]).expand(3, 2, 3), atol=1e-5, rtol=0)
    assert surroundings(batch.points[:, :4], cloud, batch.points[cloud, 0], 6).shape == (3, 6, 3)


@given(st.integers(1, 40), st.integers(0, 12), st.integers(0, 1000))
@settings(max_examples=25)
def test_a_whole_clouds_surroundings_are_those_of_its_points(size: int, count: int, seed: int) -> None:
    points = torch.randn(1, size, 3, generator=torch.Generator().manual_seed(seed))
    around = nearest_points(cKDTree(points[0].numpy()), points[0].numpy(), count)
    assert around.shape == (size, count)
    if count:
        alone = surroundings(points, torch.zeros(size, dtype=torch.long), points[0], count)
        torch.testing.assert_close(points[0][around] - points[0][:, None], alone)


def test_critics_and_affordance_networks_are_told_what_lies_around() -> None:
    module, batch = Prior(TINY), clouds(1)
    cloud, point = torch.zeros(3, dtype=torch.long), torch.arange(3)
    encoded = module.encoder(batch)
    known = module.encoder.at(encoded, cloud, point)
    alone = module.encoder.features_at(encoded, cloud, point)
    assert known.shape == (3, TINY.point_width)
    assert torch.equal(point_features(known, TINY), alone)
    frames, points = orthonormal_frames(torch.randn(3, 6)), batch.points[0, :3]
    elsewhere = torch.cat([alone, torch.rand(3, 3 * TINY.surroundings)], dim=-1)
    scores = [module.action_logits(features, points, frames) for features in (known, elsewhere)]
    assert not torch.allclose(*scores)
    assert not torch.allclose(*(module.actionability(features, points) for features in (known, elsewhere)))
    # Which rotations are worth trying is asked of the features alone, as published.
    noise = torch.randn(3, 4, TINY.noise_width)
    assert torch.equal(*(module.propose(features[:, None], noise) for features in (known, elsewhere)))


def codes(module: Aap, count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    draw = torch.Generator().manual_seed(seed)
    frames = orthonormal_frames(torch.randn(count, 6, generator=draw))
    features, points = torch.randn(count, TINY.point_width, generator=draw), torch.randn(count, 3, generator=draw)
    motions = torch.rand(count, generator=draw)
    return module.interaction_codes(features, points, frames, motions, (motions > 0.5).float())


@given(st.integers(1, 12), st.integers(0, 1000))
@settings(max_examples=25)
def test_latent_forgets_the_order(count: int, seed: int) -> None:
    module = Aap(TINY)
    z, w = codes(module, count, seed)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    torch.testing.assert_close(module.latent(z[order], w[order]), module.latent(z, w), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("evidence", [False, True])
def test_latents_of_prefixes_are_the_latents_of_the_prefixes(evidence: bool) -> None:
    module = Aap(TINY.model_copy(update={"evidence": evidence}))
    z, w = codes(module, 9)
    prefixes = module.prefix_latents(z, w)
    assert torch.equal(prefixes[0], module.empty_latent)
    for k in range(1, 10):
        torch.testing.assert_close(prefixes[k], module.latent(z[:k], w[:k]), rtol=1e-4, atol=1e-5)
        mean = (z[:k] * w[:k, None]).sum(0) / w[:k].sum()
        assert torch.allclose(prefixes[k], mean, rtol=1e-4, atol=1e-5) != evidence


def test_attention_weights_are_positive_whatever_the_weights_say() -> None:
    module = Aap(TINY)
    torch.nn.init.constant_(module.attention_head.output.bias, -1e4)
    z, w = codes(module, 4)
    assert (w > 0).all()
    assert torch.isfinite(module.prefix_latents(z, w)).all()


def test_affordance_does_not_bend_the_critics_features() -> None:
    module = Aap(TINY)
    batch = clouds(1)
    features = module.encoder.at(module.encoder(batch), torch.zeros(4, dtype=torch.long), torch.arange(4))
    points, latents = batch.points[0, :4], torch.zeros(12, requires_grad=True)
    module.actionability(features, points, latents).sum().backward()
    moved = {name for name, p in module.named_parameters() if p.grad is not None}
    assert moved
    assert all(name.startswith(("affordance_head", "place_encoder")) for name in moved)


@pytest.mark.parametrize(
    "change", [{"radii": (0.1,)}, {"centres": (8, 24)}, {"feature_width": 17}, {"neighbours": 0}, {"widht": 3}]
)
def test_inconsistent_configurations_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        NetworkConfig.model_validate(TINY.model_dump() | change)


def test_clouds_do_not_keep_the_indices_that_they_are_made_of() -> None:
    kept: list[weakref.ref[np.ndarray]] = []

    def groupings() -> Iterator[Grouping]:
        for cloud in stacked:
            grouping = group_cloud(cloud, TINY)
            kept.append(weakref.ref(grouping.neighbours[0]))
            yield grouping
            # One is at hand, in here and where it is stacked; others would be in memory twice.
            assert sum(each() is not None for each in kept) == 1

    stacked = np.random.default_rng(0).uniform(size=(4, 32, 3)).astype(np.float32)
    batch = CloudBatch.of(stacked, groupings())
    assert torch.equal(batch.neighbours[0][3], torch.from_numpy(group_cloud(stacked[3], TINY).neighbours[0]))


def test_outcome_details_of_every_kind_and_width_differ_and_unknown_ones_are_zeros() -> None:
    kinds = [*OutcomeKind, OutcomeKind.OK]
    told = outcome_details(kinds, [float("nan")] * len(OutcomeKind) + [0.02])
    assert told.shape == (len(kinds), DETAIL_WIDTH)
    nothing = [row for kind, row in zip(kinds, told, strict=True) if kind not in TOLD_KINDS]
    assert len(nothing) == 3
    assert not np.any(nothing)
    assert len({row.tobytes() for row in told}) == len(TOLD_KINDS) + 2
    hostile = outcome_details(["ok", "no-such-kind"], [float("inf"), 1e300])
    assert np.isfinite(hostile).all()
    assert hostile[0, -2:].tolist() == [0.0, 0.0]


def test_details_are_left_out_one_by_one() -> None:
    whole = torch.from_numpy(outcome_details(["ok"] * 3, [0.02] * 3))
    kept = without_details(whole, torch.tensor([False, True, True]), torch.tensor([False, False, True]))
    assert torch.equal(kept[0], whole[0])
    assert torch.equal(kept[1], torch.from_numpy(outcome_details(["unknown"], [0.02]))[0])
    assert not kept[2].any()


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_an_outcome_enters_with_details_only_where_the_setting_says_so(name: str) -> None:
    told = NETWORKS[name].model_copy(update={"outcome_details": True})
    motions = successes = torch.zeros(2)
    held_and_slipped = torch.from_numpy(outcome_details(["ok", "no-grasp"], [0.02, 0.0]))
    plain = outcome_inputs(motions, successes, NETWORKS[name], held_and_slipped)
    assert torch.equal(plain, outcome_inputs(motions, successes, NETWORKS[name]))
    assert torch.equal(plain[0], plain[1])
    detailed = outcome_inputs(motions, successes, told, held_and_slipped)
    assert detailed.shape == (2, outcome_width(told))
    assert not torch.equal(detailed[0], detailed[1])
    unknown = torch.from_numpy(outcome_details(["unknown"] * 2, [float("nan")] * 2))
    assert torch.equal(outcome_inputs(motions, successes, told), outcome_inputs(motions, successes, told, unknown))
