"""The segmentation of a raw scan: floor and walls by geometry, the rest by a network, and parts from its votes.

What the network says of a scan may be averaged with what it said of earlier scans since which the object has not moved.
Its errors differ from scan to scan, as the noise and the points that it is given do.

Shapes: M points of a scan, N points that the network is given.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from safetensors.torch import save
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor, nn

from shared.config import StrictModel
from shared.errors import StoreError, UsageError
from shared.io.documents import parse_document
from shared.networks.layers import PointwiseMlp
from shared.networks.network_config import NetworkConfig
from shared.networks.pointnet2 import CloudBatch, PointNet2, group_cloud
from shared.policies.policy import MAX_WEIGHTS_BYTES, WEIGHTS_FILE, read_tensors
from shared.segmentation.inputs import EXTRA, SegmentationInput, network_input
from shared.segmentation.scenes import MOVABLE, Kind
from shared.types import Float, Float32

SEGMENTATION_NETWORK = NetworkConfig(
    centres=(1024, 256, 64, 16),
    radii=(0.1, 0.25, 0.7, 2.5),
    neighbours=16,
    abstraction=((32, 48), (64, 96), (128, 192), (192, 256)),
    propagation=((192,), (160,), (128,), (128, 96)),
    feature_width=96,
    surroundings=0,
)
"""Small, and with a last level that sees a whole object: where the middle of a door is depends on all of it."""


class SegmentationNetwork(nn.Module):
    """PointNet++ with two heads: logits of `kinds` classes, and the offset of the middle of the point's part (VoteNet).

    Args:
        config: sizes of the encoder.
        kinds: number of classes.
        extra: number of inputs of a point beside its place.
    """

    def __init__(self, config: NetworkConfig, kinds: int, extra: int) -> None:
        super().__init__()
        self.kinds = kinds
        self.encoder = PointNet2(config, extra)
        self.head = PointwiseMlp(config.feature_width, (config.feature_width,), "layer")
        self.output = nn.Linear(config.feature_width, kinds + 3)

    def forward(self, clouds: CloudBatch) -> tuple[Tensor, Tensor]:
        """Clouds to logits [B, N, kinds] and offsets [B, N, 3], in the cloud's units."""
        count, size = clouds.points.shape[:2]
        cloud = torch.arange(count).repeat_interleave(size)
        point = torch.arange(size).repeat(count)
        features = self.encoder.features_at(self.encoder(clouds), cloud, point)
        output = self.output(self.head(features)).reshape(count, size, -1)
        return output[..., : self.kinds], output[..., self.kinds :]


SEGMENTATION_FILE = "segmentation.json"
MAX_DOCUMENT_BYTES = 1 << 16
PEAK_M, APART_M = 0.12, 0.3
"""Votes within the first are counted together; those within the second of a maximum are for the same middle."""
JOINED = 0.35
"""Clusters whose middles are nearer than this share of the extent of both together are one part."""
LEAST_VOTES = 15
"""The fewest points of the network's input that make a part."""
FEW_POINTS = 60
"""A part of so many points of the network's input is half as confident as a large one."""
TOUCHING_M = 0.12
"""Points of the network's input that are nearer to each other belong to one thing."""
ABSORBED = 0.05
"""A thing with a smaller share of the object's points than this is left out."""
NEAREST = 3
"""Points of the network's input whose labels a point of the scan takes the most frequent of, and points of an earlier
scan that are averaged with a point of a later one."""
AVERAGED_M = 0.03
"""Points of two scans that are further apart are not averaged."""


class SegmentationDocument(StrictModel):
    """The contents of segmentation.json."""

    format: Literal["adaafford-segmentation"] = "adaafford-segmentation"
    schema_version: Literal[1] = 1
    network: NetworkConfig
    weights_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


@dataclass(frozen=True, slots=True)
class Part:
    """A movable part that was found.

    Attributes:
        points: [any], the points of the scan that are of it.
        confidences: of each way to move, its mean probability over the points, less for a part of few points; in
            [0, 1].
    """

    points: NDArray[np.int64]
    confidences: Mapping[Kind, float]

    @property
    def kind(self) -> Kind:
        """How it moves."""
        return max(self.confidences, key=self.confidences.__getitem__)

    @property
    def confidence(self) -> float:
        """That it moves in one of the ways in `confidences`."""
        return sum(self.confidences.values())


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the network says at some points of a scan: the mean over this scan and earlier ones.

    Attributes:
        points: [N, 3].
        probabilities: [N, kinds].
        votes: [N, 3], the middles that are voted for, in the frame of the points.
        scans: [N], over how many scans the mean is; it is itself a mean of what earlier points had, so no whole number.
    """

    points: Float
    probabilities: Float
    votes: Float
    scans: Float

    def averaged(self, earlier: "Evidence") -> "Evidence":
        """The mean with earlier scans, of what did not move in between; each scan counts as much as another."""
        away, near = map(np.asarray, cKDTree(earlier.points).query(self.points, NEAREST, workers=-1))
        weights = (away < AVERAGED_M) / np.maximum((away < AVERAGED_M).sum(axis=1, keepdims=True), 1)
        before = (weights * earlier.scans[near]).sum(axis=1)
        share = (weights * (before / (before + self.scans))[:, None])[..., None]
        own = 1 - share.sum(axis=1)
        return replace(
            self,
            probabilities=own * self.probabilities + (share * earlier.probabilities[near]).sum(axis=1),
            votes=own * self.votes + (share * earlier.votes[near]).sum(axis=1),
            scans=before + self.scans,
        )


@dataclass(frozen=True, slots=True)
class Segmentation:
    """What was found in a scan.

    Attributes:
        object: [any], the points of the scan that are of the object.
        parts: the most confident first.
        evidence: what that was found from; None: of no use to later scans.
    """

    object: NDArray[np.int64]
    parts: tuple[Part, ...]
    evidence: Evidence | None = None


class Segmenter:
    """Segments raw scans."""

    def __init__(self, network: SegmentationNetwork) -> None:
        self.network = network

    def segment(self, points: Float, camera: Float, seed: int = 0, earlier: Evidence | None = None) -> Segmentation:
        """Find the object in a scan, and its movable parts.

        Args:
            points: [M, 3], z up, metres.
            camera: [3], in the same frame.
            seed: of the random choices.
            earlier: of scans since which the object has not moved, in the same frame.

        Raises:
            UsageError: there is nothing but floor and walls, or no object.
        """
        given, frame = network_input(points, camera, seed)
        probabilities, votes = self._evaluated(given)
        said = probabilities.astype(np.float64), frame.back(votes.astype(np.float64))
        evidence = Evidence(points[given.rows], *said, np.ones(len(votes)))
        if earlier is not None:
            evidence = evidence.averaged(earlier)
            probabilities = evidence.probabilities.astype(np.float32)
            votes = frame.place(evidence.votes).astype(np.float32)
        kinds = probabilities.argmax(axis=1)
        labels = part_labels(given.points, kinds, votes)
        if not (labels >= 0).any():
            raise UsageError("no object is seen in the scan; move the camera towards it")
        spread = _spread(points[given.left], points[given.rows], labels)
        parts = []
        for label in range(1, labels.max() + 1):
            mine = labels == label
            rows = given.left[spread == label]
            if mine.any() and len(rows):
                share = mine.sum() / (mine.sum() + FEW_POINTS)
                parts.append(Part(rows, {k: float(share * probabilities[mine, k].mean()) for k in MOVABLE}))
        parts.sort(key=lambda part: -part.confidence)
        return Segmentation(given.left[spread >= 0], tuple(parts), evidence)

    @torch.no_grad()
    def _evaluated(self, given: SegmentationInput) -> tuple[Float32, Float32]:
        """Probabilities of the kinds, [N, kinds], and the middles that are voted for, [N, 3]."""
        clouds = CloudBatch.of([given.points], [group_cloud(given.points, SEGMENTATION_NETWORK)], [given.extra])
        logits, offsets = self.network(clouds)
        return torch.softmax(logits[0], dim=-1).numpy(), given.points + offsets[0].numpy()

    def to_files(self) -> dict[str, bytes]:
        """The network as files, in half precision: weights.safetensors and segmentation.json."""
        weights = save({name: tensor.half().contiguous() for name, tensor in self.network.state_dict().items()})
        document = SegmentationDocument(
            network=SEGMENTATION_NETWORK, weights_sha256=hashlib.sha256(weights).hexdigest()
        )
        return {WEIGHTS_FILE: weights, SEGMENTATION_FILE: document.model_dump_json(indent=1).encode() + b"\n"}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> "Segmenter":
        """Read a segmentation network, trusting nothing.

        Raises:
            StoreError: a file is missing, damaged, foreign or of another version.
        """
        data, weights = files.get(SEGMENTATION_FILE, b""), files.get(WEIGHTS_FILE, b"")
        document = parse_document(SegmentationDocument, data, SEGMENTATION_FILE, "it is damaged or foreign")
        if hashlib.sha256(weights).hexdigest() != document.weights_sha256 or len(weights) > MAX_WEIGHTS_BYTES:
            raise StoreError(f"the SHA-256 of {WEIGHTS_FILE} is not that of {SEGMENTATION_FILE}; train it again")
        if document.network != SEGMENTATION_NETWORK:
            raise StoreError(f"{SEGMENTATION_FILE}: is of a network of other sizes; train it again")
        network = begun(0)
        network.load_state_dict(read_tensors(weights, network.state_dict(), WEIGHTS_FILE))
        network.eval().requires_grad_(False)
        return cls(network)


def begun(seed: int) -> SegmentationNetwork:
    """A network with random weights that depend on `seed` alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return SegmentationNetwork(SEGMENTATION_NETWORK, len(Kind), EXTRA)


def part_labels(points: Float32, kinds: NDArray[np.int64], votes: Float32) -> NDArray[np.int64]:
    """Of each of the network's points -1 for background, 0 for the object's body, n for the n-th part, [N]."""
    labels = np.full(len(points), -1)
    of_object = np.flatnonzero(kinds != Kind.BACKGROUND)
    labels[of_object[_one_thing(points[of_object])]] = 0
    mine = np.flatnonzero(np.isin(kinds, MOVABLE) & (labels == 0))
    labels[mine] = _clusters(points[mine], votes[mine]) + 1
    return labels


def _one_thing(points: Float32) -> NDArray[np.bool_]:
    """Which points are of the largest thing, or of one of a size that counts beside it, [any]."""
    if len(points) == 0:
        return np.zeros(0, dtype=bool)
    pairs = cKDTree(points).query_pairs(TOUCHING_M, output_type="ndarray")
    graph = csr_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    _, things = connected_components(graph, directed=False, return_labels=True)
    kept: NDArray[np.bool_] = (np.bincount(things) >= ABSORBED * len(points))[things]
    return kept


def _clusters(points: Float32, votes: Float32) -> NDArray[np.int64]:
    """Numbers of the parts that points vote for, from 0, [any]; -1 for votes for what hardly any other votes for."""
    numbers = np.full(len(votes), -1)
    if len(votes) < LEAST_VOTES:
        return numbers
    tree = cKDTree(votes)
    support = np.asarray(tree.query_ball_point(votes, PEAK_M, return_length=True))
    left, peaks = np.ones(len(votes), dtype=bool), []
    while left.any():
        peak = int(np.where(left, support, -1).argmax())
        if support[peak] < LEAST_VOTES:
            break
        middle = votes[tree.query_ball_point(votes[peak], PEAK_M)].mean(axis=0)
        around = np.linalg.norm(votes - middle, axis=1) < APART_M
        if (around & left).sum() >= LEAST_VOTES:
            peaks.append(middle)
        left &= ~around
        left[peak] = False
    if not peaks:
        return numbers
    numbers = np.asarray(cKDTree(np.array(peaks)).query(votes)[1], dtype=np.int64)
    return _merged(points, votes, numbers)


def _merged(points: Float32, votes: Float32, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Clusters after those were joined that vote for one middle, for the size of what they are together.

    The middles of two doors beside each other are half as far apart as both are wide; votes for one door are nearer.
    """
    while True:
        found = np.unique(numbers)
        middles = np.array([np.median(votes[numbers == number], axis=0) for number in found])
        best, pair = JOINED, None
        for one, other in combinations(range(len(found)), 2):
            apart = middles[other] - middles[one]
            length = max(float(np.linalg.norm(apart)), 1e-6)
            along = points[np.isin(numbers, found[[one, other]])] @ (apart / length)
            ratio = length / max(float(np.ptp(np.percentile(along, [5, 95]))), 1e-6)
            if ratio < best:
                best, pair = ratio, (one, other)
        if pair is None:
            return np.searchsorted(found, numbers)
        numbers = np.where(numbers == found[pair[1]], found[pair[0]], numbers)


def _spread(points: Float, known: Float, labels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Labels of points, [any, 3], from those of some of them, [N, 3]."""
    near = np.asarray(cKDTree(known).query(points, k=NEAREST, workers=-1)[1])
    told = labels[near]
    # The nearest counts unless the two others agree against it.
    outvoted = (told[:, 1] == told[:, 2]) & (told[:, 0] != told[:, 1])
    spread: NDArray[np.int64] = np.where(outvoted, told[:, 1], told[:, 0])
    return spread
