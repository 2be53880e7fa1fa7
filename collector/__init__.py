"""Objects, the SAPIEN scene, the gripper, cameras, proposers and rollouts: everything that makes interactions."""
