"""The loop that observes, proposes and executes, and the recorder of its interactions."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from collector.random_proposer import RandomProposer
from collector.sim.simulator import SimEnvironment, StageClock
from shared.geometry import quaternion_from_rotation
from shared.plan import InteractionRecord
from shared.primitives import hand_start
from shared.types import Action, Float, Interaction, Observation, Order, Outcome, OutcomeKind, Proposer, Role


def interact(
    environment: SimEnvironment,
    proposer: Proposer,
    most: int,
    *,
    history: Sequence[Interaction] = (),
    start: Float | None = None,
    execute: Callable[[Observation, Action], Outcome] | None = None,
    clock: StageClock | None = None,
) -> Iterator[Interaction]:
    """The paper's test-time loop: observe, propose, execute, extend the history.

    It ends after `most` interactions, or earlier if the proposer stops, if no point that the task may act on is visible
    (a part can move out of the camera's view), or if the simulation has diverged.

    Args:
        environment: to act in.
        proposer: chooses the actions.
        most: number of interactions.
        history: earlier interactions; the proposer receives these and those of this loop.
        start: [parts], a state that is restored before each interaction; None: each continues from the last.
        execute: executes an action instead of the environment, so that the caller can record it.
        clock: sums wall time by stage.
    """
    clock = clock or StageClock()
    known = list(history)
    for _ in range(most):
        if start is not None:
            environment.restore(start)
        observation = environment.observe()
        if not observation.movable.any():
            return
        with clock.stage("propose"):
            action = proposer.propose(observation, known)
        if action is None:
            return
        outcome = execute(observation, action) if execute else environment.execute(action)
        known.append(Interaction(observation, action, outcome))
        yield known[-1]
        if outcome.kind is OutcomeKind.UNSTABLE:
            return  # Later states of this scene are not valid.


@dataclass(slots=True)
class Recorder:
    """Gathers what a rollout does: interactions in order, and every observation once."""

    environment: SimEnvironment
    policy_version: int
    clock: StageClock
    observations: list[Observation] = field(default_factory=list)
    interactions: list[InteractionRecord] = field(default_factory=list)

    def interact(
        self,
        proposer: Proposer,
        most: int,
        role: Role,
        *,
        history: Sequence[Interaction] = (),
        start: Float | None = None,
        method: str = "",
        budget: int = -1,
    ) -> list[Interaction]:
        """Run the loop and write down every interaction; see the function `interact`.

        Args:
            proposer: chooses the actions.
            most: interactions.
            role: what the interactions are for.
            history: interactions that the proposer knows already.
            start: [parts], a state that is put back before each interaction. None: each continues from the last.
            method: whose interactions these are, in evaluation.
            budget: how many interactions the method had before, in evaluation.

        Returns:
            The interactions of this loop.
        """
        order = Order.CONTINUE if start is None else Order.RESTART

        def execute(observation: Observation, action: Action) -> Outcome:
            return self._execute(observation, action, proposer.name, order, role, method, budget)

        loop = interact(
            self.environment, proposer, most, history=history, start=start, execute=execute, clock=self.clock
        )
        return list(loop)

    @property
    def sound(self) -> bool:
        """Whether the simulation has not diverged; nothing that follows could be believed."""
        return not self.interactions or self.interactions[-1].outcome.kind is not OutcomeKind.UNSTABLE

    def _execute(
        self,
        observation: Observation,
        action: Action,
        proposer: str,
        order: Order,
        role: Role,
        method: str,
        budget: int,
    ) -> Outcome:
        """Execute an action and record the interaction."""
        environment = self.environment
        part = int(observation.part_ids[action.point_index])
        body = environment.object.bodies[part]
        assert body.joint is not None
        state = environment.privileged(part)
        begun = time.perf_counter()
        outcome = environment.execute(action)
        self.interactions.append(
            InteractionRecord(
                step=len(self.interactions),
                observation=self._place_of(observation),
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
        return outcome

    def _place_of(self, observation: Observation) -> int:
        """Where the observation is kept; a new one is added."""
        for place, kept in enumerate(self.observations):
            if kept is observation:
                return place
        self.observations.append(observation)
        return len(self.observations) - 1
