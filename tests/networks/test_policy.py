"""Policies: what is written is what is read, and nothing hostile is believed."""

import hashlib
import json

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from shared.errors import StoreError, UsageError
from shared.networks.network_config import NetworkConfig
from shared.policies.policy import POLICY_FILE, WEIGHTS_FILE, Policy
from shared.tasks import TASKS, Task
from tests.support.small_networks import TINY


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    return Policy.untrained("push", TINY, seed=3).with_trained("prior").to_files()


def resealed(files: dict[str, bytes], weights: bytes, **changes: object) -> dict[str, bytes]:
    """Files whose checksum is right, as somebody who means harm would write them."""
    document = json.loads(files[POLICY_FILE]) | {"weights_sha256": hashlib.sha256(weights).hexdigest()} | changes
    return {WEIGHTS_FILE: weights, POLICY_FILE: json.dumps(document).encode()}


def test_a_policy_comes_back_bit_for_bit(files: dict[str, bytes]) -> None:
    policy = Policy.from_files(files)
    assert (policy.task, policy.config, policy.trained) == ("push", TINY, {"prior"})
    assert policy.to_files() == files


def test_a_policy_records_the_hand_of_its_training_and_warns_of_another(
    files: dict[str, bytes], caplog: pytest.LogCaptureFixture
) -> None:
    panda = Policy.from_files(files)
    assert panda.gripper == "panda" and "gripper" not in json.loads(files[POLICY_FILE])
    suction = Policy.untrained("push", TINY, seed=3).of_hand("suction").with_pinch(True, False, 1)
    read = Policy.from_files(suction.without_baselines().to_files())
    assert read.gripper == "suction"
    for policy in (panda, read):
        policy.warn_of_other_hand(policy.gripper)
    assert not caplog.records
    read.warn_of_other_hand("panda")
    assert caplog.messages == [
        "the policy was trained with the hand 'suction', and is used with the hand 'panda', of which it knows nothing"
    ]


def test_a_policy_records_the_task_that_a_file_defined(files: dict[str, bytes]) -> None:
    assert "task_definition" not in json.loads(files[POLICY_FILE])
    assert Policy.from_files(files).task_record == TASKS.get("push")
    lid = Task(name="pull-lid", primitive="pull", revolute_only=True)
    begun = Policy.untrained("pull-lid", TINY, seed=3)
    assert begun.task_record is None, "no package defines it"
    defined = begun.defined_as(lid).with_pinch(True, False, 1).without_baselines().to_files()
    assert Policy.from_files(defined).task_record == lid
    foreign = resealed(defined, defined[WEIGHTS_FILE], task="push")
    with pytest.raises(StoreError, match="'pull-lid' is defined"):
        Policy.from_files(foreign)


def test_first_weights_depend_on_the_seed_alone() -> None:
    torch.manual_seed(0)
    state = torch.random.get_rng_state()
    one, two, other = (Policy.untrained("push", TINY, seed).to_files()[WEIGHTS_FILE] for seed in (1, 1, 2))
    assert one == two != other
    assert torch.equal(torch.random.get_rng_state(), state)


def test_a_module_that_is_not_trained_is_not_used(files: dict[str, bytes]) -> None:
    with pytest.raises(UsageError, match="aip is not trained"):
        Policy.from_files(files).require("prior", "aip")


def test_hostile_weights_are_refused(files: dict[str, bytes]) -> None:
    tensors = load(files[WEIGHTS_FILE])
    name = "aap.empty_latent"
    for bad in (torch.full_like(tensors[name], np.nan), torch.full_like(tensors[name], np.inf)):
        with pytest.raises(StoreError, match="not finite"):
            Policy.from_files(resealed(files, save(tensors | {name: bad})))
    with pytest.raises(StoreError, match=r"needs torch\.float32"):
        Policy.from_files(resealed(files, save(tensors | {name: torch.zeros(5)})))
    with pytest.raises(StoreError, match=r"needs torch\.float32"):
        Policy.from_files(resealed(files, save(tensors | {name: tensors[name].double()})))
    with pytest.raises(StoreError, match="unknown"):
        Policy.from_files(resealed(files, save(tensors | {"more": torch.zeros(1)})))
    with pytest.raises(StoreError, match="missing"):
        Policy.from_files(resealed(files, save({k: v for k, v in tensors.items() if k != name})))


@pytest.mark.parametrize(
    "weights", [b"", b"\xff" * 40, b"PK\x03\x04 a pickle in a zip", b"\x08" + b"\0" * 7 + b"[" * 8]
)
def test_weights_that_are_not_safetensors_are_refused(files: dict[str, bytes], weights: bytes) -> None:
    with pytest.raises(StoreError, match="safetensors"):
        Policy.from_files(resealed(files, weights))


def test_truncated_weights_are_refused_whatever_the_checksum_says(files: dict[str, bytes]) -> None:
    for cut in (1, 100, len(files[WEIGHTS_FILE]) - 8):
        with pytest.raises(StoreError, match="SHA-256"):
            Policy.from_files(files | {WEIGHTS_FILE: files[WEIGHTS_FILE][:-cut]})
        with pytest.raises(StoreError, match="safetensors"):
            Policy.from_files(resealed(files, files[WEIGHTS_FILE][:-cut]))


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (b"", "damaged or foreign"),
        (b"[" * 5000, "damaged or foreign"),
        (b" " * (1 << 17), "larger than"),
        (b'{"format": "other"}', "damaged or foreign"),
    ],
)
def test_hostile_documents_are_refused(files: dict[str, bytes], document: bytes, message: str) -> None:
    with pytest.raises(StoreError, match=message) as error:
        Policy.from_files(files | {POLICY_FILE: document})
    assert "\n" not in str(error.value)


def test_other_versions_and_missing_files_are_refused(files: dict[str, bytes]) -> None:
    with pytest.raises(StoreError, match="schema version 2"):
        Policy.from_files(resealed(files, files[WEIGHTS_FILE], schema_version=2))
    for name in files:
        with pytest.raises(StoreError, match=name):
            Policy.from_files({n: data for n, data in files.items() if n != name})


def test_an_absurdly_large_network_is_refused_without_being_built(files: dict[str, bytes]) -> None:
    wide = (2048,) * 8
    network = NetworkConfig(abstraction=(wide,) * 3, propagation=(wide, wide, (*wide[1:], 128)))
    changes = {"network": network.model_dump(mode="json")}
    with pytest.raises(StoreError, match=r"asks for \d+ weights"):
        Policy.from_files(resealed(files, files[WEIGHTS_FILE], **changes))


def test_weights_of_another_network_are_refused(files: dict[str, bytes]) -> None:
    changes = {"network": NetworkConfig().model_dump(mode="json")}
    with pytest.raises(StoreError, match=r"another network|needs torch\.float32"):
        Policy.from_files(resealed(files, files[WEIGHTS_FILE], **changes))


def test_half_precision_is_half_the_size_and_says_nearly_the_same() -> None:
    policy = Policy.untrained("push", TINY, seed=3).with_trained("prior")
    whole, half = policy.to_files(), policy.to_files(half=True)
    again = Policy.from_files(half)
    assert len(half[WEIGHTS_FILE]) < 0.6 * len(whole[WEIGHTS_FILE])
    assert (again.task, again.config, again.trained) == (policy.task, policy.config, policy.trained)
    for name, tensor in again.modules().state_dict().items():
        before = policy.modules().state_dict()[name]
        assert tensor.dtype == before.dtype
        torch.testing.assert_close(tensor, before, rtol=1e-3, atol=1e-6)
    assert again.to_files(half=True) == half


def test_weights_that_half_precision_cannot_hold_are_not_exported_in_it(files: dict[str, bytes]) -> None:
    policy = Policy.from_files(files)
    policy.aap.empty_latent[0] = 1e6
    with pytest.raises(UsageError, match="do not fit into half precision"):
        policy.to_files(half=True)


def test_networks_that_would_take_gigabytes_a_cloud_are_refused(files: dict[str, bytes]) -> None:
    network = NetworkConfig().model_dump(mode="json")
    network |= {"centres": [2048, 128, 32], "neighbours": 128, "abstraction": [[2048], [64], [128]]}
    with pytest.raises(StoreError, match="choose fewer"):
        Policy.from_files(resealed(files, files[WEIGHTS_FILE], network=network))


@pytest.mark.parametrize(
    "changes",
    [
        {"shape": [2**32, 2**32]},
        {"shape": [0, 2**63]},
        {"shape": [2**64, 0]},
        {"shape": "x"},
        {"dtype": "F4"},
        {"data_offsets": [0, 2**63]},
        {"data_offsets": [-1, 4]},
        {"data_offsets": [8, 4]},
        {"data_offsets": [0, 0]},
    ],
)
def test_tensors_that_are_not_where_or_what_they_must_be_are_refused(
    files: dict[str, bytes], changes: dict[str, object]
) -> None:
    data = files[WEIGHTS_FILE]
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    next(entry for name, entry in sorted(header.items()) if name != "__metadata__").update(changes)
    forged = json.dumps(header).encode()
    with pytest.raises(StoreError, match=r"tensor|safetensors"):
        Policy.from_files(resealed(files, len(forged).to_bytes(8, "little") + forged + data[8 + length :]))


def test_a_header_of_many_megabytes_is_refused_before_it_is_read(files: dict[str, bytes]) -> None:
    data = files[WEIGHTS_FILE]
    length = int.from_bytes(data[:8], "little")
    blanks = 5 << 20
    padded = (length + blanks).to_bytes(8, "little") + data[8 : 8 + length] + b" " * blanks + data[8 + length :]
    with pytest.raises(StoreError, match="header of"):
        Policy.from_files(resealed(files, padded))
