"""Scans for policies that are told pinch profiles: all measured points count, not only those of the cloud."""

from pathlib import Path

import numpy as np
import pytest

from adaafford.scans import ScanFrame, checked_scan, observation_of
from cluster.cli.main import run
from shared.errors import UsageError
from shared.networks.actions import FRAME_WIDTH
from shared.networks.network_config import NetworkConfig
from shared.pinch import BINS
from shared.policies.adaptation import Adapter
from shared.policies.policy import Policy
from shared.types import Action, Float, Observation
from tests.support.small_networks import TINY
from tests.support.small_policies import policy_of

TOLD = TINY.model_copy(update={"pinch_profile": True})


def wall(spacing: float, right: float = 0.3) -> Float:
    """A wall 0.9 m ahead of a camera at the origin, z up, that ends at y = `right`."""
    y, z = np.meshgrid(np.arange(-0.3, right, spacing), np.arange(-0.3, 0.3, spacing))
    return np.stack([np.full(y.size, 0.9), y.ravel(), z.ravel()], axis=1)


def seen_at(points: Float, spot: tuple[float, float, float]) -> tuple[Observation, Action]:
    """A scan, and a pull at the spot of it whose closing axis is along y."""
    frame = ScanFrame.around(checked_scan(points))
    observation = observation_of(checked_scan(points), frame)
    place = frame.to_world([spot])[0]
    index = int(np.linalg.norm(observation.points - place, axis=1).argmin())
    turn = frame.world_from_scan
    rotation = np.stack([turn @ [0, 0, 1], turn @ [0, -1, 0], turn @ [1, 0, 0]], axis=1)
    return observation, Action(index, observation.points[index].astype(np.float64), rotation)


def test_the_edge_of_a_dense_scan_is_seen() -> None:
    observation, action = seen_at(wall(0.004, 0.2), (0.9, 0.2, 0.0))
    frames = Adapter(policy_of(TOLD)).frames(observation, [action])
    there = frames[0, FRAME_WIDTH + BINS : FRAME_WIDTH + 2 * BINS]
    # The closing axis is -y: the wall begins in the middle and goes on to the last bin.
    assert there[: BINS // 2 - 2].sum() == 0
    assert (there[BINS // 2 + 1 :] == 1).all()


def test_a_thin_scan_is_refused_only_by_policies_that_need_more() -> None:
    observation, action = seen_at(wall(0.03), (0.9, 0.0, 0.0))
    assert Adapter(policy_of(TINY)).score(observation, [action], []).shape == (1,)
    with pytest.raises(UsageError, match=r"points are 0\.03\d? m apart; give the scan before it is thinned"):
        Adapter(policy_of(TOLD)).score(observation, [action], [])


def test_adapt_proposes_for_a_dense_scan_and_refuses_a_thin_one_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = NetworkConfig.model_validate(TOLD.model_dump())
    policy = Policy.untrained("pull-closed-door", network, seed=5)
    for name in ("prior", "aap", "aip"):
        policy.with_trained(name)
    (tmp_path / "policy").mkdir()
    for file, data in policy.to_files(half=True).items():
        (tmp_path / "policy" / file).write_bytes(data)
    for name, spacing, code in (("dense", 0.006, 0), ("thin", 0.04, 2)):
        cloud = tmp_path / name / "scan.npz"
        cloud.parent.mkdir()
        np.savez(cloud, points=wall(spacing))
        told = ["adapt", "--cloud", str(cloud), "--history", str(cloud.parent / "h.json"), "--policy"]
        assert run([*told, str(tmp_path / "policy")]) == code
        out, err = capsys.readouterr()
        assert ('"do"' in out) is (code == 0)
        assert ("give the scan before it is thinned" in err) is (code != 0)
        assert "Traceback" not in err
