"""The same problems as rigid bodies in MuJoCo, for policies that were made for ours; extra ``mujoco``.

E. Todorov, T. Erez and Y. Tassa, "MuJoCo: A physics engine for model-based control", IROS, 2012.
"""

from importlib.util import find_spec

if find_spec("mujoco") is None:
    raise ImportError("rigid bodies need MuJoCo; install it with: pip install 'd4orm-env[mujoco]'")

from d4orm_env.mujoco.environment import env, parallel_env, raw_env
from d4orm_env.mujoco.scene import Physics, check_problem

__all__ = ["Physics", "check_problem", "env", "parallel_env", "raw_env"]
