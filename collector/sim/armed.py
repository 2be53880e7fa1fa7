"""An environment whose hand is carried by an arm: what the arm cannot reach is not executed."""

from dataclasses import replace

import numpy as np

from collector.objects.articulation import surface_at
from collector.sim.simulator import PrivilegedState, SimEnvironment, StageClock
from shared.arms.arm import Arm
from shared.arms.kinematics import ArmReach
from shared.primitives import PRIMITIVES
from shared.types import Action, Float, Observation, Outcome, OutcomeKind


class ArmedEnvironment(SimEnvironment):
    """An environment of any simulator, behind an arm.

    Args:
        environment: executes what is reached, by a hand that flies as the arm would carry it.
        arm: the arm.
        base: x, y, z and yaw of its base, world frame.
        known: whether observations tell proposers of the arm.
        clock: sums wall time by stage ("reach").
    """

    def __init__(
        self, environment: SimEnvironment, arm: Arm, base: tuple[float, ...], known: bool, clock: StageClock
    ) -> None:
        self._environment, self._arm, self._known, self._clock = environment, arm, known, clock
        self.base = base
        self.object, self.primitive = environment.object, environment.primitive
        self._observed: Observation | None = None
        self._told: dict[int, tuple[Observation, Observation, ArmReach]] = {}

    def observe(self) -> Observation:
        """The observation, with the arm if it is known."""
        self._observed = self._environment.observe()
        return self._armed(self._observed)[1]

    def execute(self, action: Action) -> Outcome:
        """Execute an action, if the arm reaches it, on the part of its point in the last observation."""
        assert self._observed is not None, "observe before you act"
        with self._clock.stage("reach"):
            reached = self._armed(self._observed)[2].trajectory(action) is not None
        if reached:
            return self._environment.execute(action)
        # On the static body nothing is to be moved, so that any joint will do, as in a trial.
        part = max(int(self._observed.part_ids[action.point_index]), 1)
        at = float(self._environment.state()[part - 1])
        return Outcome(OutcomeKind.UNREACHABLE, 0.0, False, at, at, np.zeros(3))

    def _armed(self, observed: Observation) -> tuple[Observation, Observation, ArmReach]:
        """The observation without and with the arm, and the arm's reach; the same objects as long as it is the same."""
        if id(observed) not in self._told:
            part = int(observed.part_ids[observed.movable][0]) if observed.movable.any() else 1
            surface = surface_at(self.object, self._environment.privileged(part).joint_positions)
            reach = ArmReach(self._arm, self.base, PRIMITIVES.get(self.primitive), surface)
            self._told[id(observed)] = observed, replace(observed, reach=reach) if self._known else observed, reach
        return self._told[id(observed)]

    def reset(self, rng: np.random.Generator) -> bool:
        return self._environment.reset(rng)

    def shows_a_target(self) -> bool:
        return self._environment.shows_a_target()

    def state(self) -> Float:
        return self._environment.state()

    def restore(self, state: Float) -> None:
        self._environment.restore(state)

    def privileged(self, part: int) -> PrivilegedState:
        return self._environment.privileged(part)
