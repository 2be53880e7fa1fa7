"""Training stages one after another in one process, which remembers what they share: `python -m cluster.learning`.

Each line of its standard input is the arguments of one `adaafford train`, a JSON list; after each it prints a line of
`ENDED` and the exit code. The other end is `cluster.children.Learner`.
"""

import json
import sys
from functools import partial

from cluster.children import ENDED
from cluster.cli import begin_process, guarded
from cluster.commands import train
from learner.stages import Memory


def main() -> None:
    """Run what comes, until no more can come."""
    begin_process()
    memory = Memory()
    for line in sys.stdin:
        arguments = json.loads(line)
        code = guarded(partial(train.main, arguments, memory), ["train", *arguments])
        print(f"{ENDED}{code}", flush=True)


if __name__ == "__main__":
    main()
