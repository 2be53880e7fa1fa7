"""A program between `adaafford adapt` and a robot, tried on a simulated one: `python examples/robot.py FOLDER`.

On hardware, take scan and outcome from your camera and arm instead of the process `robot`; the lines stay the same.
Ended at any moment, the program goes on with the same folder, and no interaction is executed or counted twice.
"""

import json
import subprocess
import sys
from pathlib import Path

folder = Path(sys.argv[1])
adaafford = [sys.executable, "-m", "cluster"]
pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "bufsize": 1}

# Its lines are a scan and, after the first, the outcome of the interaction before it: {"cloud": "scan-1.npz"}.
robot = subprocess.Popen([*adaafford, "rehearse", str(folder), "--task", "push-faucet", "--no-marked"], **pipes)
request = json.loads(robot.stdout.readline())

# The first answer is to the scan that stands on the command line; the following ones are to lines.
where = ["--cloud", str(folder / request["cloud"]), "--history", str(folder / "history.json")]
session = subprocess.Popen(
    [*adaafford, "adapt", *where, "--policy", "push-faucet", "--budget", "2", "--follow"], **pipes
)
answer = json.loads(session.stdout.readline())
if "outcome" in request:  # The program was ended before; the session is told again, and counts it once.
    print(json.dumps(request), file=session.stdin, flush=True)
    answer = json.loads(session.stdout.readline())

while answer["do"] == "try":
    print(json.dumps(answer), file=robot.stdin, flush=True)
    request = json.loads(robot.stdout.readline())
    print(f"interaction {answer['interaction']}: {request['outcome']}")
    print(json.dumps(request), file=session.stdin, flush=True)
    answer = json.loads(session.stdout.readline())

print(f"the action that should succeed, belief {answer['belief']:.2f}: point {answer['point']}")
for process in (session, robot):
    process.stdin.close()
    process.wait()
