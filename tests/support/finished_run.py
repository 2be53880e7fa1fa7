"""A finished run out of thin air: procedural faucets, a published policy with random weights, no interactions.

run = make_finished_run(tmp_path / "run")
"""

import json
from pathlib import Path

from cluster.config.campaign_config import CampaignConfig
from cluster.runs.run_folder import ObjectsUsed, RunFolder, begin
from collector.objects.catalogue import scan
from collector.objects.procedural.catalogue import generate
from shared.networks.network_config import NetworkConfig
from shared.plan import Setting
from shared.policies.policy import Policy
from shared.store import Store
from shared.tasks import task_named

SMALL_NETWORK = NetworkConfig(
    centres=(32, 8),
    radii=(0.3, 0.8),
    neighbours=4,
    abstraction=((8,), (16,)),
    propagation=((16,), (16,)),
    feature_width=16,
    latent_width=16,
)


def make_finished_run(path: Path, objects: int = 4, task: str = "push-faucet") -> RunFolder:
    """A run whose first half of `objects` was trained on, with policy 1, whose weights are as before training."""
    config = CampaignConfig(
        task=task,
        workers=0,
        alternations=0,
        collection=CampaignConfig().collection.model_validate({"camera": {"points": 256, "image_size": 128}}),
        learner=CampaignConfig().learner.model_copy(update={"network": SMALL_NETWORK}),
    )
    run = begin(path, config)
    generate(run.generated_objects, {"Faucet": objects}, seed=1)
    refs = [entry.ref for entry in scan(run.generated_objects).usable]
    used = ObjectsUsed(
        folder=run.generated_objects.name,
        train=tuple(refs[: objects // 2]),
        validation=(),
        test=tuple(refs[objects // 2 :]),
        refused=(),
    )
    run.objects_file.write_text(json.dumps(used.model_dump(mode="json")))
    collection = task_named(task).resolve(config.collection)
    store = Store.create(run.store, Setting(task=task, seed=1, objects=used.train, collection=collection))
    policy = Policy.untrained(task, SMALL_NETWORK, seed=3)
    for name in ("prior", "aap", "aip"):
        policy.with_trained(name)
    store.publish_policy(1, policy.to_files())
    return run
