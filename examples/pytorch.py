"""Train a PyTorch network of your own on a store: `python examples/pytorch.py STORE CHECKPOINT`.

The network sees one point of a cloud and predicts whether an interaction there succeeds. Stop the script at any moment:
the same command goes on with the very samples that were left. The few epochs only check that the script works.
"""

import sys
from pathlib import Path

import torch
from torch import nn
from torch.utils.data import DataLoader

import adaafford

where, checkpoint = sys.argv[1], Path(sys.argv[2])
EPOCHS = 2

# The samples: cells of the interactions and fields of their clouds. Shards come in an order that the seed and the epoch
# decide. `num_workers=4` reads them by four processes; with `torchrun`, each process gets its share.
dataset = adaafford.InteractionDataset(
    where, columns=["point_index", "rotation", "success"], clouds=["points", "normals", "movable"], seed=1
)
torch.manual_seed(1)
model = nn.Sequential(nn.Linear(3 + 3 + 3 + 9, 64), nn.ReLU(), nn.Linear(64, 1))
optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)
if checkpoint.exists():
    saved = torch.load(checkpoint)
    model.load_state_dict(saved["model"])
    optimiser.load_state_dict(saved["optimiser"])
    dataset.load_state_dict(saved["data"])
    print(f"goes on in epoch {dataset.epoch}")

for epoch in range(dataset.epoch, EPOCHS):
    dataset.set_epoch(epoch)
    losses = []
    for batch in DataLoader(dataset, batch_size=16, num_workers=0):
        # p and its normal, relative to the middle of what may be moved, and the rotation R of the hand.
        row = torch.arange(len(batch["success"]))
        point, normal = (batch[name][row, batch["point_index"].long()] for name in ("points", "normals"))
        movable = batch["movable"][..., None].float()
        middle = (batch["points"] * movable).sum(1) / movable.sum(1).clamp_min(1.0)
        features = torch.cat([point - middle, normal, middle, batch["rotation"].float()], 1)
        loss = nn.functional.binary_cross_entropy_with_logits(model(features)[:, 0], batch["success"].float())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
        # What was used, and the weights that came of it, belong into one file.
        dataset.consumed(batch["position"])
        state = {"model": model.state_dict(), "optimiser": optimiser.state_dict(), "data": dataset.state_dict()}
        torch.save(state, checkpoint.with_suffix(".tmp"))
        checkpoint.with_suffix(".tmp").replace(checkpoint)
    if losses:
        print(f"epoch {epoch}: {len(losses)} batches, loss {sum(losses) / len(losses):.3f}")
