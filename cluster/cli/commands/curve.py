"""`adaafford curve`: how much critics know about hidden facts after some interactions; needs neither Ray nor SAPIEN."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from cluster.config.flags import OutFolder, parse_flags
from shared.errors import UsageError

if TYPE_CHECKING:
    from cluster.evaluation.curves import Curves
    from learner.data.features import FrozenFeatures
    from learner.evaluation.curve import Answers, Candidates, ProposalGain
    from shared.policies.policy import Policy


@dataclass(frozen=True, slots=True)
class CurveCommand:
    """Evaluate trainings on stored rollouts of unseen objects by number of interactions, and draw the curve."""

    store: str
    """Folder or s3:// URL of the store; it is only read."""
    runs: tuple[str, ...]
    """NAME=RUN ...: the --out of `train alternate`, aap or aip. Runs with the same name are seeds of one training. A
    run without an oracle is compared with the oracle of the run at the same position of another name."""
    out: OutFolder | None = None
    """A folder for curve.md, curve.csv, curve.png and curve.json."""
    tries: tuple[int, ...] = (0, 1, 2, 4)
    """Numbers of interactions."""
    draws: int = 4
    """How often contexts and queries are drawn from each rollout."""
    seed: int = 0
    """Of the draws."""
    threads: int | None = None
    """Of PyTorch; unset: as many as it chooses."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(args: list[str]) -> int:
    """Judge, and write what came of it."""
    command = parse_flags(CurveCommand, args, "curve", CurveCommand(tyro.MISSING, tyro.MISSING))
    if not command.tries or min(command.tries) < 0 or max(command.tries) > 64:
        raise UsageError(f"--tries {command.tries}: give numbers from 0 to 64, such as 0 1 2 4")
    if not 1 <= command.draws <= 100:
        raise UsageError(f"--draws {command.draws}: give a number from 1 to 100")
    if command.seed < 0:
        raise UsageError(f"--seed {command.seed}: give a number of 0 or more")
    if command.threads is not None and not 1 <= command.threads <= 1024:
        raise UsageError(f"--threads {command.threads}: give a number from 1 to 1024")
    curves = _judge(command, named_runs(command.runs))
    from cluster.evaluation.curves import as_json, as_markdown, write_curves

    print(as_markdown(curves))
    if command.out is not None:
        write_curves(command.out, curves)
        print(f"{command.out}: curve.md, curve.csv, curve.png, curve.json")
    if command.json:
        print(json.dumps(as_json(curves), allow_nan=False))
    return 0


def named_runs(given: tuple[str, ...]) -> dict[str, list[Path]]:
    """Folders by name, in the order given.

    Raises:
        UsageError: one is not NAME=RUN.
    """
    runs: dict[str, list[Path]] = {}
    for text in given:
        name, equals, folder = text.partition("=")
        if not (name and equals and folder):
            raise UsageError(f"--runs {text}: give NAME=RUN, such as privileged=runs/seed-1")
        runs.setdefault(name, []).append(Path(folder))
    return runs


def _judge(command: CurveCommand, runs: dict[str, list[Path]]) -> "Curves":
    import torch

    from cluster.evaluation.curves import Curves
    from learner.alternation import trained_in
    from learner.data.dataset import load_dataset
    from learner.data.features import FrozenFeatures
    from learner.evaluation.curve import Candidates, curve_rows
    from learner.stages.jobs import objects_seen, read_policy_folder
    from learner.stages.trainers import ORACLE_FILE
    from shared.store.store import Store

    if command.threads is not None:
        torch.set_num_threads(command.threads)
    trained = {name: [trained_in(folder) for folder in folders] for name, folders in runs.items()}
    policies = {name: [read_policy_folder(folder) for folder in all_] for name, all_ in trained.items()}
    store = Store.open(command.store)
    for name, of_name in policies.items():
        for folder, policy in zip(runs[name], of_name, strict=True):
            policy.require_task(store.setting.task, str(folder))
            policy.require("prior", "aap")
    every = [policy for found in policies.values() for policy in found]
    _check_alike(every)
    seen = frozenset().union(*(objects_seen(folder) for all_ in trained.values() for folder in all_))
    new = {ref.id for ref in store.setting.objects if ref.content_hash not in seen}
    dataset = load_dataset(store, every[0].config)
    rollouts = dataset.rollouts_of(new)
    if not rollouts:
        raise UsageError(f"{command.store}: the trainings have seen all its objects; collect on others (--seed)")
    candidates = Candidates.of(dataset, rollouts, command.draws, command.seed)
    if candidates.count < max(command.tries):
        raise UsageError(f"--tries {max(command.tries)}: the store's rollouts leave {candidates.count} to try")
    rows, gains = [], {}
    for name, found in trained.items():
        answers = []
        for place, (run, policy) in enumerate(zip(found, policies[name], strict=True)):
            others = (all_[place] for all_ in trained.values() if place < len(all_))
            oracle = next((path for each in (run, *others) if (path := each / ORACLE_FILE).is_file()), None)
            # Kept for one run alone, so that memory does not grow with their number.
            known = FrozenFeatures(dataset)
            answered, gained = _answers(known, candidates, policy, oracle, command.tries, gains=name not in gains)
            answers.append((str(place + 1), answered))
            if gained:
                gains[name] = gained
            print(f"judged {runs[name][place]}", flush=True)
        rows += curve_rows(name, answers)
    return Curves(
        task=dataset.task,
        digest=store.digest(),
        rollouts=len(set(candidates.rollouts)),
        left_out=len(dataset.rollouts) - len(rollouts),
        draws=command.draws,
        rows=tuple(rows),
        gains=gains,
    )


def _check_alike(policies: "list[Policy]") -> None:
    """Refuse policies whose networks look at other neighbours of a point.

    Raises:
        UsageError: they do.
    """
    seen_alike = {(p.config.centres, p.config.radii, p.config.neighbours) for p in policies}
    if len(seen_alike) > 1:
        raise UsageError(
            "the runs' networks differ in centres, radii or neighbours; judge them by commands of their own"
        )


def _answers(
    known: "FrozenFeatures",
    candidates: "Candidates",
    policy: "Policy",
    oracle: Path | None,
    tries: tuple[int, ...],
    *,
    gains: bool,
) -> "tuple[Answers, list[ProposalGain]]":
    """A run's answers and, if wanted, how much its proposals tell."""
    from learner.data.features import FrozenAap
    from learner.evaluation.curve import answer, proposal_gains
    from learner.stages.oracle import read_oracle

    policy.modules().eval().requires_grad_(False)
    frozen = FrozenAap.of(policy.aap, known)
    aip = policy.aip if "aip" in policy.trained else None
    told = None if oracle is None else read_oracle(oracle, policy.config)
    answered = answer(known, candidates, frozen, policy.prior, aip, told, tries)
    return answered, proposal_gains(known, candidates, frozen, aip) if gains and aip is not None else []
