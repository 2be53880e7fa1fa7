"""Two agents in a Gymnasium environment: `python examples/agents.py OBJECTS [EPISODES]`.

The random agent uses nothing but Gymnasium. The other one is AIP of a policy that comes with the package: it interacts
up to three times, and its last action is the one that AAP then scores highest. docs/gymnasium.md describes the spaces.
"""

import sys

import gymnasium
import numpy as np

import adaafford

objects, episodes = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 4
SEED, TRIES = 5, 3
env = gymnasium.make("adaafford/PushFaucet-v0", objects=objects)
env = gymnasium.wrappers.RecordEpisodeStatistics(env)

# A random point that may be acted on, and the approach against the surface's normal there.
env.action_space.seed(SEED)
for episode in range(episodes):
    seen, info = env.reset(seed=SEED if episode == 0 else None)
    over = False
    while not over:
        mask = {"point_index": seen["movable"], "approach": None, "forward": None}
        action = env.action_space.sample(mask=mask)
        action["approach"] = -seen["normals"][action["point_index"]]
        seen, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    print(f"random on {info['object_id']}: {info['episode']['r']:.0f} of {info['episode']['l']} succeed")

# The same rollouts: `from_gymnasium` makes the environment one in which proposers act, as they do on a robot.
adapter = adaafford.Adapter(adaafford.load_policy("push-faucet-sparse"))
robot = adaafford.from_gymnasium(env, seed=SEED)
for episode in range(episodes):
    rng = np.random.default_rng(episode)
    history: list[adaafford.Interaction] = []
    aip = adaafford.AipProposer(adapter, rng, TRIES)
    while not robot.over and (action := aip.propose(observation := robot.observe(), history)) is not None:
        history.append(adaafford.Interaction(observation, action, robot.execute(action)))
    if not robot.over:
        final = adaafford.ExploitProposer(adapter, rng).propose(robot.observe(), history)
        assert final is not None, "an exploit never stops"
        outcome = robot.execute(final)
        print(
            f"aip on {robot.info['object_id']}: after {len(history)} interactions it moves by {outcome.motion:.2f} rad"
        )
    robot.reset()
env.close()
