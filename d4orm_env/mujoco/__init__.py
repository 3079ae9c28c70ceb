"""The same problems as rigid bodies in MuJoCo, for policies that were made for ours; extra ``mujoco``.

E. Todorov, T. Erez and Y. Tassa, "MuJoCo: A physics engine for model-based control", IROS, 2012.
"""

from d4orm_env.mujoco.environment import env, parallel_env, raw_env
from d4orm_env.mujoco.physics import Physics

__all__ = ["Physics", "env", "parallel_env", "raw_env"]
