# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""Lines of text files of datasets, and the numbers in them; every error names file and line."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from gam_relocalizer.errors import DatasetError
from gam_relocalizer.geometry import rigid3d_from, rigid3d_from_rotation

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import pycolmap
    from numpy.typing import NDArray

# Digits printed are few, and a slip of a column is far off.
_ROTATION_TOLERANCE = 1e-2
_MAX_LINE = 2**16
_MAX_NS = Decimal(10) ** 21


@dataclass(frozen=True)
class Line:
    """One line of a file.

    Attributes:
        words: Its columns.
        where: `file:line`, for errors.
    """

    words: tuple[str, ...]
    where: str

    def expect(self, columns: int, meaning: str) -> None:
        """Refuses a line of fewer columns.

        Raises:
            DatasetError: With what was expected.
        """
        if len(self.words) < columns:
            msg = f'{self.where}: expected `{meaning}`, found `{" ".join(self.words)[:80]}`'
            raise DatasetError(msg)

    def numbers(self, begin: int, count: int, meaning: str) -> NDArray[np.float64]:
        """The numbers [count] in columns `begin` and following; they may be infinite or NaN.

        Raises:
            DatasetError: Too few columns, or one that is no number.
        """
        self.expect(begin + count, meaning)
        try:
            return np.array([_number(word) for word in self.words[begin : begin + count]])
        except ValueError as err:
            msg = f'{self.where}: expected `{meaning}`: {err}'
            raise DatasetError(msg) from err

    def file_name(self, column: int) -> str:
        """The name of a file below the dataset's folder.

        Raises:
            DatasetError: A name that leads out of the folder.
        """
        name = PurePosixPath(self.words[column])
        if name.is_absolute() or '..' in name.parts:
            msg = f'{self.where}: `{name}` lies outside of the dataset'
            raise DatasetError(msg)
        return str(name)

    def stamp_ns(self, unit: int) -> int:
        """The time [ns] in the first column, exactly.

        Args:
            unit: Nanoseconds per unit of the column.

        Raises:
            DatasetError: No number, or one that is no time.
        """
        try:
            value = Decimal(self.words[0])
        except InvalidOperation:
            value = Decimal('NaN')
        if not value.is_finite() or abs(value) > _MAX_NS / unit:
            msg = f'{self.where}: expected a time, found `{self.words[0][:40]}`'
            raise DatasetError(msg)
        return int(value * unit)


def read_lines(file: Path, separator: str | None = None, header: int = 0) -> Iterator[Line]:
    """The lines of a text file, without empty ones and comments (#).

    Args:
        file: The file.
        separator: Between columns; white space by default.
        header: So many lines at the beginning are skipped, whatever they hold.

    Raises:
        DatasetError: The file is missing or not a text.
    """
    try:
        with file.open(encoding='utf-8') as stream:
            number = 0
            while text := stream.readline(_MAX_LINE):
                number += 1
                where = f'{file}:{number}'
                if len(text) == _MAX_LINE:
                    msg = f'{where}: a line of more than {_MAX_LINE - 1} characters; not a text'
                    raise DatasetError(msg)
                words = tuple(word.strip() for word in text.strip().split(separator))
                if number > header and any(words) and not words[0].startswith('#'):
                    yield Line(words, where)
    except FileNotFoundError as err:
        msg = f'{file}: missing'
        raise DatasetError(msg) from err
    except (OSError, UnicodeDecodeError) as err:
        msg = f'{file}: cannot be read as a text: {err}'
        raise DatasetError(msg) from err


def pose_of_quaternion(
    wxyz: NDArray[np.float64], translation: NDArray[np.float64], where: str
) -> pycolmap.Rigid3d:
    """A rigid transform from a unit quaternion [4] and a translation [3].

    Raises:
        DatasetError: Numbers that are not finite, or a quaternion that is not of length one.
    """
    _check_finite(np.concatenate([wxyz, translation]), where)
    if abs(np.linalg.norm(wxyz) - 1.0) > _ROTATION_TOLERANCE:
        msg = f'{where}: the quaternion {wxyz.tolist()} is not of length one'
        raise DatasetError(msg)
    return rigid3d_from(wxyz, translation)


def pose_of_matrix(matrix: NDArray[np.float64], where: str) -> pycolmap.Rigid3d:
    """A rigid transform from its matrix, [3,4] or [4,4].

    Raises:
        DatasetError: Numbers that are not finite, or a matrix that is no rigid transform.
    """
    _check_finite(matrix, where)
    rotation = matrix[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    last_row_off = np.abs(matrix[3:] - [0.0, 0.0, 0.0, 1.0]).max(initial=0.0)
    if max(off, last_row_off) > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        msg = f'{where}: not a rotation and a translation: {matrix.round(4).tolist()}'
        raise DatasetError(msg)
    # printed digits make it a rotation but for rounding: the nearest true one
    left, _, right = np.linalg.svd(rotation)
    return rigid3d_from_rotation(Rotation.from_matrix(left @ right), matrix[:3, 3])


def _number(word: str) -> float:
    # Windows of old prints what is not finite as 1.#INF, -1.#IND or 1.#QNAN
    return float('nan') if '.#' in word else float(word)


def _check_finite(numbers: NDArray[np.float64], where: str) -> None:
    if not np.isfinite(numbers).all():
        msg = f'{where}: numbers that are not finite: {numbers.tolist()}'
        raise DatasetError(msg)
