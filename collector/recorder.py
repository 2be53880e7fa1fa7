"""The loop that every rollout runs, and what it writes down."""

import time
from dataclasses import dataclass, field

import numpy as np

from collector.clock import StageClock
from collector.proposers import RandomProposer
from collector.simulator import SimEnvironment
from shared.geometry import quaternion_from_rotation
from shared.primitives import hand_start
from shared.records import InteractionRecord
from shared.vocabulary import Action, Interaction, Observation, Order, OutcomeKind, Proposer, Role


@dataclass(slots=True)
class Recorder:
    """Gathers what a rollout does: interactions in order, and every observation once."""

    environment: SimEnvironment
    policy_version: int
    observations: list[Observation] = field(default_factory=list)
    interactions: list[InteractionRecord] = field(default_factory=list)

    def try_action(
        self, action: Action, proposer: str, order: Order, role: Role, method: str = "", budget: int = -1
    ) -> Interaction:
        """Execute an action from the environment's present state and write down what came of it."""
        environment = self.environment
        observation = environment.observe()
        place = self._place_of(observation)
        part = int(observation.part_ids[action.point_index])
        body = environment.object.bodies[part]
        assert body.joint is not None
        state = environment.privileged(part)
        begun = time.perf_counter()
        outcome = environment.execute(action)
        self.interactions.append(
            InteractionRecord(
                step=len(self.interactions),
                observation=place,
                action=action,
                outcome=outcome,
                normal=observation.normals[action.point_index].astype(np.float64),
                primitive=environment.primitive,
                order=order,
                role=role,
                proposer=proposer,
                policy_version=0 if proposer == RandomProposer.name else self.policy_version,
                method=method,
                budget=budget,
                target_part=part,
                target_link=body.link,
                target_joint=body.joint.name,
                joint_names=tuple(each.joint.name for each in environment.object.parts if each.joint is not None),
                joint_positions=state.joint_positions,
                joint_limits=state.joint_limits,
                joint_twist=state.joint_twist,
                hand_start=np.concatenate([hand_start(action), quaternion_from_rotation(action.rotation)]),
                seconds=time.perf_counter() - begun,
            )
        )
        return Interaction(observation, action, outcome)

    @property
    def sound(self) -> bool:
        """Whether the simulation has not diverged; nothing that follows could be believed."""
        return not self.interactions or self.interactions[-1].outcome.kind is not OutcomeKind.UNSTABLE

    def _place_of(self, observation: Observation) -> int:
        """Where the observation is kept; a new one is added."""
        for place, kept in enumerate(self.observations):
            if kept is observation:
                return place
        self.observations.append(observation)
        return len(self.observations) - 1


def try_repeatedly(
    recorder: Recorder,
    proposer: Proposer,
    most: int,
    role: Role,
    history: list[Interaction],
    method: str,
    clock: StageClock,
) -> None:
    """The loop of the paper's test time: observe, propose, execute, remember; each try continues from the last.

    Args:
        recorder: of the environment to act in.
        proposer: chooses what to try; it ends the loop by proposing nothing.
        most: how long the history may become.
        role: what the tries are for.
        history: what is known already; the tries are added to it.
        method: whose tries these are, in evaluation.
        clock: sums wall time by stage.
    """
    while recorder.sound and len(history) < most:
        observation = recorder.environment.observe()
        if not observation.movable.any():  # A part can swing out of the camera's sight.
            return
        with clock.stage("propose"):
            action = proposer.propose(observation, history)
        if action is None:
            return
        history.append(recorder.try_action(action, proposer.name, Order.CONTINUE, role, method))


def try_from_one_state(recorder: Recorder, proposer: Proposer, count: int, role: Role, clock: StageClock) -> None:
    """Several actions from the environment's present state, which is put back before each and in the end."""
    environment = recorder.environment
    observation = environment.observe()
    state = environment.state()
    for _ in range(count):
        environment.restore(state)
        with clock.stage("propose"):
            action = proposer.propose(observation, ())
        if action is None:
            return
        recorder.try_action(action, proposer.name, Order.RESTART, role)
        if not recorder.sound:
            return
    environment.restore(state)
