"""Learning with pinch profiles: rows, pools and policies are told the same of an action."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from cluster.config.campaign_config import CampaignConfig
from cluster.runs.run_folder import RunFolder
from cluster.runs.warm_start import warm_start, with_needed_depth
from learner.data.dataset import load_dataset
from learner.data.features import FrozenFeatures, ProposalPool
from learner.data.sampling import draw_flips
from learner.settings import AugmentationConfig, LearnerConfig
from learner.stages.jobs import StageJob, run_stage
from shared.config import CameraConfig, CollectionConfig
from shared.errors import UsageError
from shared.networks.actions import FRAME_WIDTH
from shared.pinch import BINS, PROFILE_WIDTH
from shared.plan import Plan
from shared.policies.adaptation import Adapter, dense_in_view
from shared.policies.policy import Policy
from shared.policies.proposers import AipProposer, ExploitProposer
from shared.store import Store
from shared.types import Interaction
from tests.support.fabricate import fabricate_setting
from tests.support.small_networks import TINY
from tests.support.small_policies import policy_of
from tests.support.small_trainings import FAST, fabricated_plan, fabricated_rollouts, make_store

TOLD = TINY.model_copy(update={"pinch_profile": True})
PLAN = Plan(setting=fabricate_setting(objects=4, points=64, keep_depth=True))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return make_store(tmp_path_factory.mktemp("pinch") / "store", fabricated_rollouts(PLAN), PLAN)


def test_rows_are_told_what_a_policy_is_told(store: Store) -> None:
    dataset, adapter = load_dataset(store, TOLD), Adapter(policy_of(TOLD))
    assert dataset.rows.frame.shape[1] == FRAME_WIDTH + PROFILE_WIDTH
    there = dataset.rows.frame[:, FRAME_WIDTH + BINS : FRAME_WIDTH + 2 * BINS]
    assert 0 < there.mean() < 1
    for record, rows in zip(store.read_rollouts(store.jobs()[0].shard_id), dataset.rollouts, strict=True):
        for interaction, row in zip(record.interactions, rows.tolist(), strict=True):
            frames = adapter.frames(record.observations[interaction.observation], [interaction.action])
            torch.testing.assert_close(frames[0], dataset.rows.frame[row], atol=1e-4, rtol=0)


def test_proposals_at_a_pool_are_told_what_a_policy_is_told(store: Store) -> None:
    dataset, policy = load_dataset(store, TOLD), policy_of(TOLD)
    pool = ProposalPool.of(policy.prior, FrozenFeatures.with_pool(dataset, np.random.default_rng(0)))
    cloud, slot = torch.tensor([0, 5]), torch.tensor([2, 3])
    frames = pool.draw(cloud, slot, 7, np.random.default_rng(1))
    assert frames.shape == (2, 7, FRAME_WIDTH + PROFILE_WIDTH)
    observation, adapter = store.read_observations(store.jobs()[0].shard_id).observation(5), Adapter(policy)
    index = np.full(7, int(pool.point[5, 3]))
    told = adapter._told(observation, index, frames[1, :, :FRAME_WIDTH])
    torch.testing.assert_close(told, frames[1], atol=1e-4, rtol=0)


def test_without_the_setting_nothing_is_read_or_told(store: Store) -> None:
    dataset = load_dataset(store, TINY)
    assert dataset.dense is None
    assert dataset.rows.frame.shape[1] == FRAME_WIDTH


def test_a_store_without_depth_images_is_refused(tmp_path: Path) -> None:
    without = make_store(tmp_path / "store", plan=fabricated_plan())
    with pytest.raises(UsageError, match=r"keeps no depth images.*--collection\.camera\.keep-depth"):
        load_dataset(without, TOLD)


def test_all_stages_learn_with_profiles_and_the_policy_proposes(store: Store, tmp_path: Path) -> None:
    augmentation = AugmentationConfig(flip=True)
    config = LearnerConfig.model_validate(
        FAST.model_dump()
        | {
            "network": TOLD.model_copy(update={"roll_symmetry": True}).model_dump(),
            "prior": FAST.prior.model_dump() | {"augmentation": augmentation.model_dump()},
            "aap": FAST.aap.model_dump() | {"augmentation": augmentation.model_dump()},
        }
    )
    policy, source = None, None
    for stage in ("prior", "aap", "aip"):
        policy = run_stage(StageJob(stage=stage, store=store.path, out=tmp_path / stage, init=source), config)
        source = tmp_path / stage
    assert policy is not None
    again = Policy.from_files(policy.to_files())
    assert again.config == config.network
    record = store.read_rollouts(store.jobs()[0].shard_id)[0]
    seen = record.observations[0]
    history = [Interaction(seen, one.action, one.outcome) for one in record.interactions[:2]]
    for proposer in (
        AipProposer(Adapter(again), np.random.default_rng(0), budget=4, threshold=-1.0),
        ExploitProposer(Adapter(again), np.random.default_rng(0)),
        ExploitProposer(Adapter(again), np.random.default_rng(0), "where2act"),
    ):
        action = proposer.propose(seen, history)
        assert action is not None
        np.testing.assert_allclose(action.rotation.T @ action.rotation, np.eye(3), atol=1e-9)
    with pytest.raises(UsageError, match="keeps no depth image"):
        Adapter(again).frames(dataclasses.replace(seen, dense=None), [record.interactions[0].action])


def test_a_policy_gets_pinch_profiles_and_begins_as_the_same_functions(store: Store, tmp_path: Path) -> None:
    old = policy_of(TINY, seed=3)
    for name, data in old.to_files().items():
        (tmp_path / name).write_bytes(data)
    wider, symmetric = old.with_pinch(True, False, 1), old.with_pinch(True, True, 1)
    assert wider.config == TOLD
    assert symmetric.config == TOLD.model_copy(update={"roll_symmetry": True})
    assert not wider.trained
    record = store.read_rollouts(store.jobs()[0].shard_id)[0]
    seen, actions = record.observations[0], [one.action for one in record.interactions]
    history = [Interaction(seen, one.action, one.outcome) for one in record.interactions[:2]]
    before, after = Adapter(old), Adapter(wider)
    np.testing.assert_allclose(after.score(seen, actions, history), before.score(seen, actions, history), rtol=1e-5)
    np.testing.assert_allclose(after.prior_score(seen, actions), before.prior_score(seen, actions), rtol=1e-5)
    config = FAST.model_copy(update={"network": TOLD})
    trained = run_stage(StageJob("prior", store.where, tmp_path / "prior", tmp_path), config)
    assert trained.config == TOLD
    assert trained.trained == {"prior"}
    kept = run_stage(StageJob("prior", store.where, tmp_path / "kept", tmp_path), FAST)
    assert kept.config == TINY
    assert kept.trained == old.trained


def test_a_policy_is_not_used_where_no_depth_image_is_kept() -> None:
    policy_of(TINY).check_camera(CameraConfig())
    policy_of(TOLD).check_camera(CameraConfig(keep_depth=True))
    with pytest.raises(UsageError, match=r"set collection\.camera\.keep_depth"):
        policy_of(TOLD).check_camera(CameraConfig())


def test_a_campaign_keeps_the_depth_images_that_its_networks_need(tmp_path: Path) -> None:
    learner = {"network": {"pinch_profile": True}}
    config = CampaignConfig.model_validate({"learner": learner})
    kept = with_needed_depth(config)
    assert kept == with_needed_depth(kept)
    assert kept.model_dump() == config.model_dump() | {"collection": kept.collection.model_dump()}
    assert kept.collection == CollectionConfig(camera=CameraConfig(keep_depth=True))
    assert with_needed_depth(CampaignConfig()) == CampaignConfig()
    for networks, name in ((TINY, "plain"), (TOLD, "told")):
        (tmp_path / name).mkdir()
        for file, data in policy_of(networks).to_files().items():
            (tmp_path / name / file).write_bytes(data)
    for source, needed in (("plain", False), ("told", True)):
        # The policy decides, and not the networks that would be trained from nothing.
        started = CampaignConfig.model_validate(
            {"learner": learner, "start_from": str(tmp_path / source), "task": "push"}
        )
        assert with_needed_depth(started).collection.camera.keep_depth == needed
        # A run that has adopted it goes on without the place that it came from.
        warm_start(str(tmp_path / source), "push", RunFolder(tmp_path / f"run-{source}").adopted)
        shutil.rmtree(tmp_path / source)
        with pytest.raises(UsageError):
            with_needed_depth(started, tmp_path / "another")
        assert with_needed_depth(started, tmp_path / f"run-{source}").collection.camera.keep_depth == needed
    large = {"learner": learner, "collection": {"camera": {"image_size": 4096}}}
    with pytest.raises(UsageError, match=r"collection\.camera.*keep_depth needs an image_size of at most"):
        with_needed_depth(CampaignConfig.model_validate(large))


def test_a_cloud_without_depth_image_names_a_policy_that_needs_none() -> None:
    observation = dataclasses.replace(fabricated_rollouts(fabricated_plan(), 1)[0].observations[0], dense=None)
    with pytest.raises(UsageError, match="use a policy without that input, such as the bundled pull-sparse"):
        dense_in_view(observation)


def test_flips_are_drawn_only_where_they_are_asked_for() -> None:
    rng = np.random.default_rng(0)
    before = rng.bit_generator.state
    assert not draw_flips(50, AugmentationConfig(), rng).any()
    assert rng.bit_generator.state == before
    assert 10 < int(draw_flips(50, AugmentationConfig(flip=True), rng).sum()) < 40
    assert "flip" not in AugmentationConfig().as_document()
