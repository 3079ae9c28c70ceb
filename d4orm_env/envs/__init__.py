"""Environments of PettingZoo and Gymnasium, single and batched."""

import gymnasium

ENV_ID = "d4orm/Navigation-v0"


def register_environments() -> None:
    """Make the environments known to Gymnasium; a second call changes nothing."""
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            id=ENV_ID,
            entry_point="d4orm_env.envs.joint_env:JointNavigationEnv",
            vector_entry_point="d4orm_env.envs.vector_env:NavigationVectorEnv",
        )
