"""Policies: the networks of one task as they are trained, published, pulled by actors and carried to a robot."""

import hashlib
from collections.abc import Mapping
from typing import Literal

import torch
from pydantic import Field, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from shared.configuration import StrictModel
from shared.errors import StoreError, UsageError
from shared.methods import BaselineName, ModuleName
from shared.networks.aap import Aap
from shared.networks.aip import Aip
from shared.networks.configuration import NetworkConfig
from shared.networks.prior import Prior
from shared.networks.where2act_adaptation import Where2ActAdaptation
from shared.networks.where2act_interaction import Where2ActInteraction

WEIGHTS_FILE = "weights.safetensors"
POLICY_FILE = "policy.json"
POLICY_SCHEMA = 1
MAX_POLICY_JSON_BYTES = 1 << 16
MAX_WEIGHTS_BYTES = 1 << 30


class PolicyDocument(StrictModel):
    """The contents of policy.json."""

    format: Literal["adaafford-policy"] = "adaafford-policy"
    schema_version: int = POLICY_SCHEMA
    task: str = Field(max_length=100)
    network: NetworkConfig
    trained: tuple[ModuleName, ...]
    weights_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class Policy:
    """The prior, AAP and AIP of one task, and the learnt baselines where somebody wanted them.

    Attributes:
        task: name of the task that they were trained for.
        config: sizes of the networks.
        prior: Where2Act.
        aap: Adaptive Affordance Prediction.
        aip: Adaptive Interaction Proposal.
        where2act_interaction: the baseline of that name; None until it is begun.
        where2act_adaptation: the baseline of that name; None until it is begun.
        trained: which modules have been trained; the others hold their first weights.

    Example:
        >>> policy = Policy.from_files(store.read_policy(3))
        >>> adapter = Adapter(policy)
    """

    def __init__(self, task: str, config: NetworkConfig, trained: frozenset[ModuleName] = frozenset()) -> None:
        self.task = task
        self.config = config
        self.trained = trained
        self.prior = Prior(config)
        self.aap = Aap(config)
        self.aip = Aip(config)
        self.where2act_interaction = Where2ActInteraction(config) if "where2act-interaction" in trained else None
        self.where2act_adaptation = Where2ActAdaptation(config) if "where2act-adaptation" in trained else None

    @classmethod
    def untrained(cls, task: str, config: NetworkConfig, seed: int) -> "Policy":
        """A policy with random weights that depend on `seed` alone; the process's random state is left as it was."""
        with torch.random.fork_rng(devices=[]):
            # PyTorch's initialisers draw from the global state only.
            torch.manual_seed(seed)
            return cls(task, config)

    def begin_baseline(self, name: BaselineName, seed: int) -> None:
        """Make a learnt baseline anew, as it is before training; `seed` as for `untrained`."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            if name == "where2act-interaction":
                self.where2act_interaction = Where2ActInteraction.starting_from(self.prior)
            else:
                self.where2act_adaptation = Where2ActAdaptation(self.config)

    def modules(self) -> nn.ModuleDict:
        """The modules that there are, by name."""
        modules: dict[str, nn.Module] = {"prior": self.prior, "aap": self.aap, "aip": self.aip}
        if self.where2act_interaction is not None:
            modules["where2act-interaction"] = self.where2act_interaction
        if self.where2act_adaptation is not None:
            modules["where2act-adaptation"] = self.where2act_adaptation
        return nn.ModuleDict(modules)

    def without_baselines(self) -> "Policy":
        """A policy of the same prior, AAP and AIP, and of nothing that only an evaluation asks for."""
        with torch.device("meta"):
            kept = Policy(self.task, self.config, self.trained & {"prior", "aap", "aip"})
        kept.prior, kept.aap, kept.aip = self.prior, self.aap, self.aip
        return kept

    def with_trained(self, name: ModuleName) -> "Policy":
        """This policy, with `name` counted among the trained modules from here on."""
        self.trained |= {name}
        return self

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
        tensors = _widened(read_tensors(weights, WEIGHTS_FILE))
        # On the meta device nothing is allocated, so that absurd sizes cost nothing before they are refused.
        with torch.device("meta"):
            policy = cls(document.task, document.network, frozenset(document.trained))
        modules = policy.modules()
        check_tensors(tensors, modules.state_dict(), WEIGHTS_FILE)
        modules.load_state_dict(tensors, assign=True)
        modules.eval().requires_grad_(False)
        return policy


def read_tensors(data: bytes, source: str) -> dict[str, Tensor]:
    """Tensors from hostile safetensors bytes.

    Raises:
        StoreError: truncated or foreign.
    """
    try:
        return load(data)
    except (SafetensorError, ValueError, KeyError) as error:
        line = " ".join(str(error).split())[:100]
        raise StoreError(f"{source}: not readable as safetensors ({line}); the file is damaged or foreign") from None


def check_tensors(tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor], source: str) -> None:
    """Hold tensors to the names, shapes and types of `expected`, and to finite numbers.

    Raises:
        StoreError: with the first that differs.
    """
    odd = sorted(tensors.keys() ^ expected.keys())
    if odd:
        state = "missing" if odd[0] in expected else "unknown"
        raise StoreError(f"{source}: tensor {odd[0][:80]!r} is {state}; the weights are of another network")
    for name, tensor in tensors.items():
        want = expected[name]
        if tensor.shape != want.shape or tensor.dtype != want.dtype:
            given = f"{tensor.dtype} {tuple(tensor.shape)}"
            raise StoreError(f"{source}: tensor '{name}' is {given}, needs {want.dtype} {tuple(want.shape)}")
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise StoreError(f"{source}: tensor '{name}' holds numbers that are not finite; train again")


def _halved(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Floating-point tensors as float16; counters stay what they are."""
    halved = {name: tensor.half() if tensor.is_floating_point() else tensor for name, tensor in tensors.items()}
    for name, tensor in halved.items():
        if not bool(torch.isfinite(tensor).all()):
            raise UsageError(f"weights '{name}' do not fit into half precision; export them in full precision")
    return halved


def _widened(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors that were kept in half precision as the networks want them."""
    return {name: tensor.float() if tensor.dtype == torch.float16 else tensor for name, tensor in tensors.items()}


def _parse_document(data: bytes | None) -> PolicyDocument:
    if data is None or len(data) > MAX_POLICY_JSON_BYTES:
        raise StoreError(f"policy: {POLICY_FILE} is missing or larger than {MAX_POLICY_JSON_BYTES} bytes")
    try:
        document = PolicyDocument.model_validate_json(data)
    except ValidationError as error:
        problem = error.errors()[0]
        place = ".".join(map(str, problem["loc"])) or "the file"
        raise StoreError(f"policy: {POLICY_FILE}: {place}: {problem['msg'][:100]}; it is damaged or foreign") from None
    if document.schema_version != POLICY_SCHEMA:
        given = document.schema_version
        raise StoreError(f"policy: schema version {given}; this version reads {POLICY_SCHEMA}: publish it again")
    return document
