"""The policy that proposes: a given version, or always the newest published one."""

import time
from collections.abc import Callable

from shared.plan import Plan
from shared.store import Store

LOOK_S = 2.0
"""How often the store is searched for newer policies, s."""


class PolicySource:
    """The current plan of one proposer; call the object to get it.

    A new policy takes effect within `LOOK_S` seconds of its publication. Jobs that were handed out before, at most two
    for each actor, and their retries are still executed with the old policy.

    Args:
        store: where policies are published.
        proposer: its name.
        version: of the policy; None: always the newest.
        announce: called with each new plan before it is used; gives its policy to the workers.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        store: Store,
        proposer: str,
        version: int | None,
        announce: Callable[[Plan], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._proposer = proposer
        self._version = version
        self._announce = announce
        self._clock = clock
        self._looked = -LOOK_S
        self.plan: Plan | None = None

    def __call__(self) -> Plan | None:
        """The current plan; None while no policy is published.

        Raises:
            StoreError: the policy is not in the store, or damaged.
        """
        if self._version is None:
            self._look()
        elif self.plan is None:
            self._use(self._version)
        return self.plan

    def _look(self) -> None:
        if self._clock() - self._looked < LOOK_S:
            return
        self._looked = self._clock()
        newest = max(self._store.policy_versions(), default=0)
        if newest > (0 if self.plan is None else self.plan.policy_version):
            self._use(newest)

    def _use(self, version: int) -> None:
        plan = Plan(setting=self._store.setting, proposer=self._proposer, policy_version=version)
        self._announce(plan)
        self.plan = plan
