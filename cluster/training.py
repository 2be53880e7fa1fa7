"""The training stages of a run, and what each starts from."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cluster.adoption import adopt
from cluster.children import THREADS, Learner
from cluster.configuration import CampaignConfig
from cluster.run_folder import RunFolder
from learner.configuration import LearnerConfig
from shared.files import read_bounded, write_atomically
from shared.methods import BaselineName
from shared.plan import ObjectRef
from shared.policy import MAX_WEIGHTS_BYTES, POLICY_FILE, WEIGHTS_FILE
from shared.store import Store


class Trainer:
    """The training stages of one run; each starts from what the last one left, and leaves a whole policy.

    prior -> aap-1 -> aip-1 (published as 1) -> aap-2 -> aip-2 (published as 2) -> ...
    adopted (published as 1)                 -> aap-2 -> ..., where the run starts from a policy

    Baselines that the evaluation wants are trained before the last publication.
    """

    def __init__(self, run: RunFolder, config: CampaignConfig, say: Callable[[str], None]) -> None:
        self._run = run
        self._config = config
        self._say = say
        self._learner = Learner()

    @property
    def adopts(self) -> bool:
        """Whether the run starts from a policy, which is its version 1."""
        return self._config.start_from is not None

    def left_by(self, version: int) -> str:
        """The stage that leaves AAP and AIP of a version."""
        return "adopted" if self.adopts and version == 1 else f"aip-{version}"

    def prior(self) -> Mapping[str, Any]:
        """The Where2Act prior, from the random round."""
        return self._train("prior", "prior", None)

    def aap(self, version: int) -> Mapping[str, Any]:
        """AAP: from the prior at first, then fine-tuned with what its own AIP chose to try."""
        return self._train("aap", f"aap-{version}", "prior" if version == 1 else self.left_by(version - 1))

    def adopt(self) -> Mapping[str, Any]:
        """The policy that the run starts from, in place of one trained from nothing."""
        source = self._config.start_from
        assert source is not None, "the run starts from a policy"
        adopt(source, self._config.task, self._run.adopted)
        return {"policy_folder": str(self._run.adopted.relative_to(self._run.path))}

    def aip(self, version: int) -> Mapping[str, Any]:
        """AIP, for the AAP of the same version."""
        return self._train("aip", f"aip-{version}", f"aap-{version}")

    def baseline(self, name: BaselineName, after: str) -> Mapping[str, Any]:
        """A learnt baseline, added to the policy that the stage `after` left."""
        return self._train(name, name, after)

    def publish(self, version: int, after: str) -> Mapping[str, Any]:
        """Put the policy that the stage `after` left into the store, where collectors find it."""
        # They want its cores and its memory.
        self.close()
        folder = self._run.training(after)
        files = {name: read_bounded(folder / name, MAX_WEIGHTS_BYTES) for name in (WEIGHTS_FILE, POLICY_FILE)}
        Store.open(self._run.store).publish_policy(version, files)
        self._say(f"published policy {version}, {sum(map(len, files.values())) / 1e6:.1f} MB")
        return {"policy": version}

    def close(self) -> None:
        """End the learner."""
        self._learner.close()

    def _train(self, network: str, stage: str, init: str | None) -> dict[str, Any]:
        out = self._run.training(stage)
        out.mkdir(parents=True, exist_ok=True)
        used = self._run.objects_used()
        told = LearnerConfig(seed=self._config.seed, threads=THREADS, **dict(self._config.learner))
        arguments = [network, "--store", str(self._run.store), "--out", str(out)]
        arguments += ["--config", _written(out / "learner.toml", as_toml(told.model_dump(mode="json")))]
        arguments += ["--train-objects", _written(out / "train.txt", _ids(used.train))]
        if used.validation:
            arguments += ["--validation-objects", _written(out / "validation.txt", _ids(used.validation))]
        if init is not None:
            arguments += ["--init", str(self._run.training(init))]
        self._learner.train(arguments, out, lambda line: self._say(f"  {line}"), self._run.path)
        return {"policy_folder": str(out.relative_to(self._run.path))}


def as_toml(values: Mapping[str, Any], prefix: str = "") -> str:
    """Nested settings as TOML; what is None is left to its default, since TOML has no word for it."""
    lines, tables = [], []
    for name, value in values.items():
        if isinstance(value, Mapping):
            tables.append(f"[{prefix}{name}]\n{as_toml(value, f'{prefix}{name}.')}")
        elif value is not None:
            # Numbers, booleans, strings and arrays of these are written alike in JSON and TOML.
            lines.append(f"{name} = {json.dumps(value)}\n")
    return "".join(lines + tables)


def _written(path: Path, text: str) -> str:
    write_atomically(path, text.encode())
    return str(path)


def _ids(refs: Sequence[ObjectRef]) -> str:
    return "".join(f"{ref.id} {ref.category}\n" for ref in refs)
