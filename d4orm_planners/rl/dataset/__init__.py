"""Demonstrations of planners and policies as Minari datasets."""

from d4orm_planners.rl.dataset.demonstrations import Demonstrations, RecordedEpisode, record_episode
from d4orm_planners.rl.dataset.write import write_dataset

__all__ = ["Demonstrations", "RecordedEpisode", "record_episode", "write_dataset"]
