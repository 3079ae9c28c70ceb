"""Reading ``.npz`` files of others: nothing is unpickled, and nothing is unpacked that is not expected."""

from __future__ import annotations

import zipfile
from collections.abc import Collection
from typing import IO

import numpy as np

HEADER_BYTES = 16_384
"""Bytes that an array takes in its file beyond its content, at most."""


class ArrayArchive(zipfile.ZipFile):
    """An ``.npz`` file with the arrays that are expected, and no others.

    Args:
        stream: The file.
        names: Of the arrays.

    Raises:
        ValueError: If it holds others.
        zipfile.BadZipFile: If it is no such file.
    """

    def __init__(self, stream: IO[bytes], names: Collection[str]) -> None:
        super().__init__(stream)
        found = sorted(info.filename for info in self.infolist())
        if found != sorted(f"{name}.npy" for name in names):
            raise ValueError(f"it holds {', '.join(found[:20])}; expected {', '.join(sorted(names))}")

    def array(self, name: str, max_bytes: int) -> np.ndarray:
        """An array of at most so many bytes.

        Raises:
            ValueError: If it is larger or damaged.
        """
        info = self.getinfo(f"{name}.npy")
        # The directory may lie: then less is unpacked than it says, or no more, and the checksum fails.
        if info.file_size > max_bytes + HEADER_BYTES:
            raise ValueError(
                f"{name} does not fit: it takes {info.file_size} bytes, and at most {max_bytes} make sense"
            )
        with self.open(info) as file:
            return np.lib.format.read_array(file, allow_pickle=False)
