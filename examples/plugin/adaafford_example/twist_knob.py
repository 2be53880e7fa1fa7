"""A task: twist the switches of faucets, by this package's own primitive."""

from shared.tasks import Task

TWIST_KNOB = Task(
    name="twist-knob",
    primitive="twist",
    categories=("Faucet",),
    part_names=("switch",),
    revolute_only=True,
)
