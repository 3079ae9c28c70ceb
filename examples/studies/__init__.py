"""Studies: the numbers of the documentation, each a program that measures or reads what was measured."""

import math
from collections.abc import Mapping
from types import MappingProxyType

AS_IN_THE_PAPER: Mapping[str, float] = MappingProxyType({"goal_speed": math.inf})
"""Scenarios' arguments in most studies: goals stop robots dead."""
FIRST_SEED = 1000
"""No default was chosen by the seeds from here on."""
