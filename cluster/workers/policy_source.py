"""Which policy proposes: one version that was named, or whichever is the newest that is published."""

import time
from collections.abc import Callable

from shared.plan import Plan
from shared.store import Store

LOOK_S = 2.0
"""How often a store is asked for newer policies: part of how old a policy may be that still proposes."""


class PolicySource:
    """The plan of one proposer at each moment; call it.

    A new policy takes effect within `LOOK_S` seconds of being published. What was handed out before
    is still executed as it was: at most two jobs an actor, unless one of them fails and is tried again.

    Args:
        store: where policies are published.
        proposer: who proposes.
        version: the policy; None: always the newest.
        adopt: is called with each plan before it is in force.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        store: Store,
        proposer: str,
        version: int | None,
        adopt: Callable[[Plan], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._proposer = proposer
        self._version = version
        self._adopt = adopt
        self._clock = clock
        self._looked = -LOOK_S
        self.plan: Plan | None = None

    def __call__(self) -> Plan | None:
        """The plan in force; None while no policy is published.

        Raises:
            StoreError: the policy is not in the store, or damaged.
        """
        if self._version is None:
            self._look()
        elif self.plan is None:
            self._take_up(self._version)
        return self.plan

    def _look(self) -> None:
        if self._clock() - self._looked < LOOK_S:
            return
        self._looked = self._clock()
        newest = max(self._store.policy_versions(), default=0)
        if newest > (0 if self.plan is None else self.plan.policy_version):
            self._take_up(newest)

    def _take_up(self, version: int) -> None:
        plan = Plan(setting=self._store.setting, proposer=self._proposer, policy_version=version)
        self._adopt(plan)
        self.plan = plan
