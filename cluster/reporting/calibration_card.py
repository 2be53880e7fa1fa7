"""A calibrated policy: its fit to stores of a user's objects, and the files that it is written as."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from cluster.reporting.model_card import CARD_FILE, MAX_TABLE_BYTES, head
from cluster.runs.warm_start import folder_of
from learner.calibration import CalibratedCritic, Calibration, Fit, calibrate, check, critic_rows, together
from learner.data.dataset import Dataset, load_dataset
from learner.stages.jobs import DONE_FILE
from shared.errors import UsageError
from shared.formatting import finite, markdown_table, number
from shared.io.files import read_bounded
from shared.io.text import markdown
from shared.plan import ObjectRef
from shared.policies.policy import Policy
from shared.store import Store

COLUMNS = ("critic", "interactions", "constant", "before", "after", "gain", "questions", "objects")
CRITICS: Mapping[CalibratedCritic, str] = {"where2act": "Where2Act", "aap": "AAP"}
FITS: Mapping[Fit, str] = {"scale": "temperature and bias", "last-layer": "last layer"}


@dataclass(frozen=True, slots=True)
class CalibratedPolicy:
    """What a calibration did.

    Attributes:
        policy: calibrated, without the networks of baselines.
        source: the policy before, as the user named it.
        fit: what was fitted.
        found: by critic.
        objects: of the stores, those that the policy had not seen.
        left_out: rollouts that were left out, since the policy had seen their objects.
        seen: content hashes of all objects that the policy has seen by now, as far as is known.
        source_says: whether the policy's place says which objects it had seen before.
        digests: of the stores' interactions.
        interactions: how many of these objects the stores hold.
        successes: how many of them succeeded.
    """

    policy: Policy
    source: str
    fit: Fit
    found: Mapping[CalibratedCritic, Calibration]
    objects: tuple[ObjectRef, ...]
    left_out: int
    seen: frozenset[str]
    source_says: bool
    digests: tuple[str, ...]
    interactions: int
    successes: int


def calibrated(
    source: str, policy: Policy, stores: Sequence[Store], seen: frozenset[str], fit: Fit, seed: int
) -> CalibratedPolicy:
    """Calibrate a policy on the objects of some stores that it has not seen; its weights are changed.

    Args:
        source: the policy's name or place.
        policy: with a trained prior and AAP.
        stores: of the policy's task.
        seen: content hashes of the objects that the policy learned from or was judged by.
        fit: what is fitted.
        seed: of the draws.

    Raises:
        UsageError: a store is of another task, or there are too few objects, successes or failures.
        StoreError: a store is damaged, or holds no label.
    """
    for store in stores:
        policy.require_task(store.setting.task, source, f"{store.where} is of")
    data: list[tuple[Dataset, list[int]]] = []
    objects: dict[str, ObjectRef] = {}
    labels, owners, left_out = [np.zeros(0, np.bool_)], [np.zeros(0, np.str_)], 0
    for store in stores:
        refs = {ref.id: ref for ref in store.setting.objects}
        dataset = load_dataset(store, policy.config)
        # The same object may have other ids in other stores, and must not be on both sides of a split.
        dataset = replace(dataset, objects=tuple(refs[name].content_hash for name in dataset.objects))
        rollouts = [n for n, name in enumerate(dataset.objects) if name not in seen]
        left_out += len(dataset.objects) - len(rollouts)
        data.append((dataset, rollouts))
        hashes = {dataset.objects[n] for n in rollouts}
        objects |= {ref.content_hash: ref for ref in refs.values() if ref.content_hash in hashes}
        for n in rollouts:
            labels.append(dataset.rows.success[dataset.rollouts[n]].numpy() > 0.5)
            owners.append(np.full(len(labels[-1]), dataset.objects[n]))
    if not objects:
        raise UsageError(f"the policy has seen all objects of {stores[0].where}; collect on others to calibrate it")
    succeeded = np.concatenate(labels)
    check(succeeded, np.concatenate(owners))
    parts = [critic_rows(policy, dataset, rollouts, seed) for dataset, rollouts in data if rollouts]
    asked = {name: together([part[name] for part in parts]) for name in CRITICS}
    found = calibrate(policy, asked, fit)
    return CalibratedPolicy(
        policy=policy.without_baselines(),
        source=source,
        fit=fit,
        found=found,
        objects=tuple(objects.values()),
        left_out=left_out,
        seen=seen | objects.keys(),
        source_says=bool(seen),
        digests=tuple(store.digest() for store in stores),
        interactions=len(succeeded),
        successes=int(succeeded.sum()),
    )


def as_markdown(done: CalibratedPolicy) -> list[str]:
    """The table of cross entropies, line by line."""
    rows = [
        (
            CRITICS[row.critic],
            str(row.interactions),
            *map(number, (row.constant, row.before, row.after)),
            f"{row.gain:.3f} [{row.gain_low:.3f}, {row.gain_high:.3f}]",
            str(row.questions),
            str(row.objects),
        )
        for found in done.found.values()
        for row in found.rows
    ]
    return markdown_table(COLUMNS, rows)


def as_json(done: CalibratedPolicy) -> dict[str, Any]:
    """Fits and cross entropies by critic; numbers that are not defined are None."""
    kept = ("scale", "bias", "strength", "rows")
    told = {name: {key: asdict(found)[key] for key in kept} for name, found in done.found.items()}
    found: dict[str, Any] = finite({"fit": done.fit, "objects": len(done.objects), "left_out": done.left_out} | told)
    return found


def calibrated_files(done: CalibratedPolicy, licence: str) -> dict[str, bytes]:
    """weights.safetensors in full precision, policy.json, README.md, the card, and done.json, by name."""
    files = done.policy.to_files()
    card = (head(done.policy, files, licence, "full"), _what_was_done(done), _card_before(done.source))
    seen = {"stage": "calibrated", "objects": sorted(done.seen)}
    return {**files, CARD_FILE: ("\n\n".join(card) + "\n").encode(), DONE_FILE: json.dumps(seen).encode()}


def _what_was_done(done: CalibratedPolicy) -> str:
    categories = Counter(ref.category for ref in done.objects)
    kinds = ", ".join(f"{count} {markdown(name)}" for name, count in sorted(categories.items()))
    fits = "\n".join(
        f"- {CRITICS[name]}: scale {found.scale:.3f} (temperature {1 / found.scale:.3f}), bias {found.bias:+.3f}, "
        f"strength of the penalty {found.strength:g}"
        for name, found in done.found.items()
    )
    doubt = (
        "" if done.source_says else " The policy does not say what it learned from; some may be among these objects."
    )
    digests = ", ".join(f"`{one[:16]}`" for one in done.digests)
    return f"""## Calibration

Fitted: {FITS[done.fit]} of each critic, to {done.interactions:,} interactions ({done.successes:,} successful)
with {len(done.objects)} objects ({kinds}). Digests of the interactions: {digests}.{doubt}

Cross entropy, nats, on interactions with objects that the fit has not seen (cross-validation over objects); "constant"
is the entropy of the base rate of these interactions. In brackets: 95% bootstrap intervals over objects.

{chr(10).join(as_markdown(done))}

{fits}

- The probabilities hold for objects like these.
- The affordance networks D were rescaled by scale and bias of their critic, which was not measured.
- AIP was not trained anew: it gets the calibrated scores of AAP, and may choose other interactions."""


def _card_before(source: str) -> str:
    card = folder_of(source) / CARD_FILE
    if not card.is_file():
        return "## Before the calibration\n\nThe policy had no card."
    lines = read_bounded(card, MAX_TABLE_BYTES).decode(errors="replace").splitlines()
    demoted = "\n".join(f"##{line}" if line.startswith("#") else line for line in lines)
    return f"## Before the calibration\n\nThe card of the policy as it was:\n\n{demoted}"
