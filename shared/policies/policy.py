"""Policies: the networks of one task as they are trained, published, pulled by actors and carried to a robot."""

import hashlib
import logging
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

import torch
from pydantic import Field, model_validator
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from shared.config import PANDA, CameraConfig, CollectionConfig, Name, StrictModel
from shared.errors import StoreError, UsageError
from shared.io.documents import parse_document, parse_object
from shared.io.text import MAX_WORD, plain
from shared.networks.aap import Aap
from shared.networks.aip import Aip
from shared.networks.network_config import NetworkConfig
from shared.networks.prior import Prior
from shared.policies.methods import BASELINES, BaselineName, ModuleName
from shared.tasks import TASKS, Task, task_named

logger = logging.getLogger(__name__)

WEIGHTS_FILE = "weights.safetensors"
POLICY_FILE = "policy.json"
POLICY_SCHEMA = 1
MAX_POLICY_JSON_BYTES = 1 << 16
MAX_WEIGHTS_BYTES = 1 << 28
MAX_HEADER_BYTES = 1 << 22
"""Of a file of tensors; each has a hundred bytes in it."""
MAX_PARAMETERS = 1 << 26
METADATA = "__metadata__"
"""Of a file of tensors: texts by name."""
CORE: tuple[ModuleName, ...] = ("prior", "aap", "aip")
"""The networks of every policy."""
_KINDS = {torch.float32: "F32", torch.float16: "F16", torch.int64: "I64"}


class PolicyDocument(StrictModel):
    """The contents of policy.json."""

    format: Literal["adaafford-policy"] = "adaafford-policy"
    schema_version: int = POLICY_SCHEMA
    task: str = Field(max_length=100)
    task_definition: Task | None = Field(None, exclude_if=lambda task: task is None)
    """The task itself where a file defined it, as in the setting of a store; None: found by its name."""
    gripper: Name = Field(PANDA, exclude_if=lambda name: name == PANDA)
    network: NetworkConfig
    trained: tuple[ModuleName, ...] = Field(max_length=100)
    weights_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")

    @model_validator(mode="after")
    def _one_task(self) -> "PolicyDocument":
        if self.task_definition is not None and self.task_definition.name != self.task:
            raise ValueError(f"the task is '{self.task}', but '{self.task_definition.name}' is defined")
        return self


Module = TypeVar("Module", bound=nn.Module)


class Policy:
    """The prior, AAP and AIP of one task, and the baselines that were trained with them.

    Attributes:
        task: name of the task that they were trained for.
        task_definition: the task itself where a file defined it; None: found by its name.
        gripper: name of the hand whose interactions they were trained on.
        config: sizes of the networks.
        prior: Where2Act.
        aap: Adaptive Affordance Prediction.
        aip: Adaptive Interaction Proposal.
        baselines: networks of baselines that were begun, by name.
        trained: which modules have been trained; the others hold their first weights.

    Example:
        >>> policy = Policy.from_files(store.read_policy(3))
        >>> adapter = Adapter(policy)
    """

    def __init__(
        self,
        task: str,
        config: NetworkConfig,
        trained: frozenset[ModuleName] = frozenset(),
        gripper: str = PANDA,
        task_definition: Task | None = None,
    ) -> None:
        self.task, self.gripper, self.task_definition = task, gripper, task_definition
        self.config = config
        self.trained = trained
        self.prior = Prior(config)
        self.aap = Aap(config)
        self.aip = Aip(config)
        self.baselines: dict[BaselineName, nn.Module] = {
            name: BASELINES.get(name).network(config) for name in sorted(trained.difference(CORE))
        }

    @classmethod
    def untrained(cls, task: str, config: NetworkConfig, seed: int) -> "Policy":
        """A policy with random weights that depend on `seed` alone; the process's random state is left as it was."""
        with torch.random.fork_rng(devices=[]):
            # PyTorch's initialisers draw from the global state only.
            torch.manual_seed(seed)
            return cls(task, config)

    def begin_baseline(self, name: BaselineName, seed: int) -> None:
        """Make a learnt baseline anew, as it is before training; `seed` as for `untrained`."""
        baseline = BASELINES.get(name)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            begun = baseline.begin(self.prior) if baseline.begin is not None else baseline.network(self.config)
        self.baselines[name] = begun

    def baseline(self, name: BaselineName, kind: type[Module]) -> Module:
        """The network of a baseline that was begun, which is a `kind`."""
        network = self.baselines[name]
        assert isinstance(network, kind), f"{name} is no {kind.__name__}"
        return network

    def with_pinch(self, profile: bool, symmetry: bool, seed: int) -> "Policy":
        """An untrained policy that begins with these weights, and also with what a configuration may have of fingers.

        What profiles say counts for nothing at first: their last weights are zero. Without the symmetry, all networks
        therefore begin as the same functions.

        Args:
            profile: whether actions are given pinch profiles.
            symmetry: whether both rolls of a gripper are encoded alike.
            seed: of the other weights of the profiles' encoders.
        """
        config = self.config.model_copy(update={"pinch_profile": profile, "roll_symmetry": symmetry})
        begun = Policy.untrained(self.task, config, seed).of_hand(self.gripper).defined_as(self.task_definition)
        weights, known = begun.modules().state_dict(), self.without_baselines().modules().state_dict()
        for name, weight in weights.items():
            if name in known:
                weight.copy_(known[name])
            elif ".pinch.second." in name:
                weight.zero_()
        return begun

    def modules(self) -> nn.ModuleDict:
        """The modules that there are, by name."""
        return nn.ModuleDict({"prior": self.prior, "aap": self.aap, "aip": self.aip, **self.baselines})

    def without_baselines(self) -> "Policy":
        """A policy of the same prior, AAP and AIP, and of nothing that only an evaluation asks for."""
        with torch.device("meta"):
            trained = self.trained.intersection(CORE)
            kept = Policy(self.task, self.config, trained, self.gripper, self.task_definition)
        kept.prior, kept.aap, kept.aip = self.prior, self.aap, self.aip
        return kept

    def with_trained(self, name: ModuleName) -> "Policy":
        """This policy, with `name` counted among the trained modules from here on."""
        self.trained |= {name}
        return self

    def of_hand(self, gripper: str) -> "Policy":
        """This policy, with `gripper` as the hand that it is trained with from here on."""
        self.gripper = gripper
        return self

    def defined_as(self, definition: Task | None) -> "Policy":
        """This policy, with `definition` as what a file says of its task; None: its task is found by its name."""
        self.task_definition = definition
        return self

    @property
    def task_record(self) -> Task | None:
        """The task; None of one that neither the policy nor a package here defines."""
        return self.task_definition or (task_named(self.task) if self.task in TASKS.names() else None)

    def warn_of_other_hand(self, gripper: str) -> None:
        """Warn if interactions with `gripper` are not what the networks were trained on."""
        if self.gripper != gripper:
            logger.warning(
                "the policy was trained with the hand '%s', and is used with the hand '%s', of which it knows nothing",
                self.gripper,
                gripper,
            )

    def check_camera(self, camera: CameraConfig) -> None:
        """Check that the camera keeps what the networks need as input.

        Raises:
            UsageError: the networks need pinch profiles, and the camera keeps no depth images.
        """
        if self.config.pinch_profile and not camera.keep_depth:
            raise UsageError(
                "this policy is told what lies between the fingers, and these settings keep no depth images; set "
                "collection.camera.keep_depth"
            )

    def collection_for(self, collection: CollectionConfig) -> CollectionConfig:
        """The same settings, with depth images kept if the networks have pinch profiles as input.

        Raises:
            UsageError: the images are too large for that.
        """
        return collection.keeping_depth() if self.config.pinch_profile else collection

    def require(self, *names: ModuleName) -> None:
        """Check that modules have been trained.

        Raises:
            UsageError: one has not.
        """
        for name in names:
            if name not in self.trained:
                known = ", ".join(sorted(self.trained)) or "none"
                raise UsageError(
                    f"this policy's {name} is not trained (trained: {known}); run `adaafford train {name}`"
                )

    def require_task(self, task: str, source: str, of: str = "the store is of") -> None:
        """Check that the policy is for a task.

        Args:
            task: its name.
            source: what the policy was read from, or the option that names it.
            of: what is of the task, as a message begins to say it.

        Raises:
            UsageError: it is for another one.
        """
        if self.task != task:
            raise UsageError(f"{source}: a policy for '{self.task}', but {of} '{task}'; name one of this task")

    def to_files(self, half: bool = False) -> dict[str, bytes]:
        """The policy as files: weights.safetensors and policy.json.

        Args:
            half: keep weights as float16, of half the size; scores then agree to about 1e-3.

        Raises:
            UsageError: a weight is too large for float16.
        """
        tensors = {name: tensor.contiguous() for name, tensor in self.modules().state_dict().items()}
        weights = save(_halved(tensors) if half else tensors)
        document = PolicyDocument(
            task=self.task,
            task_definition=self.task_definition,
            gripper=self.gripper,
            network=self.config,
            trained=tuple(sorted(self.trained)),
            weights_sha256=hashlib.sha256(weights).hexdigest(),
        )
        return {WEIGHTS_FILE: weights, POLICY_FILE: document.model_dump_json(indent=1).encode()}

    @classmethod
    def from_files(cls, files: Mapping[str, bytes]) -> "Policy":
        """Read a policy, trusting nothing.

        Raises:
            StoreError: a file is missing, truncated, foreign, of another version, or holds tensors of other shapes or
                types than the configuration asks for, or numbers that are not finite.
        """
        document = _parse_document(files.get(POLICY_FILE))
        weights = files.get(WEIGHTS_FILE)
        if weights is None or len(weights) > MAX_WEIGHTS_BYTES:
            raise StoreError(f"policy: {WEIGHTS_FILE} is missing or larger than {MAX_WEIGHTS_BYTES} bytes")
        if hashlib.sha256(weights).hexdigest() != document.weights_sha256:
            raise StoreError(f"policy: the SHA-256 of {WEIGHTS_FILE} is not that of {POLICY_FILE}; publish it again")
        known = {*CORE, *BASELINES.names()}
        if unknown := sorted(set(document.trained) - known):
            raise StoreError(f"policy: has the network '{unknown[0]}'; install the package that adds this baseline")
        # On the meta device nothing is allocated, so that absurd sizes cost nothing before they are refused.
        with torch.device("meta"):
            policy = cls(
                document.task,
                document.network,
                frozenset(document.trained),
                document.gripper,
                document.task_definition,
            )
        modules = policy.modules()
        parameters = sum(tensor.numel() for tensor in modules.state_dict().values())
        if parameters > MAX_PARAMETERS:
            raise StoreError(f"policy: {POLICY_FILE} asks for {parameters} weights; allowed: {MAX_PARAMETERS}")
        tensors = read_tensors(weights, modules.state_dict(), WEIGHTS_FILE)
        modules.load_state_dict(tensors, assign=True)
        modules.eval().requires_grad_(False)
        return policy


def read_tensors(data: bytes, expected: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """Tensors from hostile safetensors bytes, of the names, shapes and types of `expected`, and of finite numbers.

    Those that were kept in half precision come in full precision.

    Raises:
        StoreError: truncated or foreign, or with the first tensor that differs.
    """
    header = tensor_header(data, source)
    odd = sorted((header.keys() - {METADATA}) ^ expected.keys())
    if odd:
        state = "missing" if odd[0] in expected else "unknown"
        raise StoreError(f"{source}: tensor '{plain(odd[0], MAX_WORD)}' is {state}; the weights are of another network")
    for name, want in expected.items():
        entry = header[name] if isinstance(header[name], dict) else {}
        kinds = (_KINDS[want.dtype], "F16") if want.is_floating_point() else (_KINDS[want.dtype],)
        if entry.get("dtype") not in kinds or entry.get("shape") != list(want.shape):
            given = plain(f"{entry.get('dtype')} {entry.get('shape')}", MAX_WORD)
            raise StoreError(f"{source}: tensor '{name}' is {given}, needs {want.dtype} {tuple(want.shape)}")
    try:
        # Those that were kept in half precision, as the networks want them.
        tensors = {name: each.float() if each.dtype == torch.float16 else each for name, each in load(data).items()}
    except (SafetensorError, ValueError, RuntimeError) as error:
        line = plain(" ".join(str(error).split()), 100)
        raise StoreError(f"{source}: not readable as safetensors ({line}); the file is damaged or foreign") from None
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise StoreError(f"{source}: tensor '{name}' holds numbers that are not finite; train again")
    return tensors


def tensor_header(data: bytes, source: str) -> dict[str, Any]:
    """What a safetensors file says of its tensors, which nobody has checked; raises as `read_tensors` does."""
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > min(MAX_HEADER_BYTES, len(data) - 8):
        raise StoreError(f"{source}: not readable as safetensors (header of {length} bytes); it is damaged or foreign")
    return parse_object(data[8 : 8 + length], source, unique=True)


def _halved(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Floating-point tensors as float16; counters stay what they are."""
    halved = {name: tensor.half() if tensor.is_floating_point() else tensor for name, tensor in tensors.items()}
    for name, tensor in halved.items():
        if not bool(torch.isfinite(tensor).all()):
            raise UsageError(f"weights '{name}' do not fit into half precision; export them in full precision")
    return halved


def _parse_document(data: bytes | None) -> PolicyDocument:
    if data is None or len(data) > MAX_POLICY_JSON_BYTES:
        raise StoreError(f"policy: {POLICY_FILE} is missing or larger than {MAX_POLICY_JSON_BYTES} bytes")
    document = parse_document(PolicyDocument, data, f"policy: {POLICY_FILE}", "it is damaged or foreign")
    if document.schema_version != POLICY_SCHEMA:
        given = str(document.schema_version)[:20]
        raise StoreError(f"policy: schema version {given}; this version reads {POLICY_SCHEMA}: publish it again")
    return document
