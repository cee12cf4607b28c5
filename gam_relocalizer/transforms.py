# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""The transforms between a robot's frames, as /tf and /tf_static tell them.

tf2's buffer is C++ and comes with a full ROS installation only; this is the small part of it that
a relocalizer needs, and offline replay needs it without any ROS.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation, Slerp

from gam_relocalizer.errors import TransformError
from gam_relocalizer.geometry import rigid3d_from_rotation, rotation_of

if TYPE_CHECKING:
    from collections.abc import Iterable

HISTORY_NS = 10 * 10**9


@dataclass
class _Edge:
    """One frame and its parent: a fixed transform, or samples in the order of their stamps."""

    parent: str
    static: bool
    stamps: list[int] = field(default_factory=list)
    samples: list[pycolmap.Rigid3d] = field(default_factory=list)


class TransformTree:
    """Frames that hang on each other, with a short history of those that move.

    Not thread-safe: feed it and ask it from one thread.
    """

    def __init__(self, history_ns: int = HISTORY_NS) -> None:
        self._history_ns = history_ns
        self._edges: dict[str, _Edge] = {}

    @property
    def frames(self) -> list[str]:
        """Names of all known frames, sorted."""
        return sorted(self._edges.keys() | {edge.parent for edge in self._edges.values()})

    def add(
        self,
        parent: str,
        child: str,
        parent_from_child: pycolmap.Rigid3d,
        stamp_ns: int,
        *,
        static: bool,
    ) -> None:
        """Takes in one transform; one for the same frame and stamp replaces the older one.

        A frame has one parent: naming another one, or turning static into dynamic, starts anew. A
        stamp that lies before the whole history means that time jumped back (a bag that loops):
        the history of that frame starts anew, too.

        Args:
            parent: Name of the frame that the transform leads to.
            child: Name of the frame that the transform comes from.
            parent_from_child: The transform.
            stamp_ns: When it holds [ns]; of no meaning for a static one.
            static: Whether it holds at all times (/tf_static).

        Raises:
            TransformError: An empty name, a frame that is its own parent, or numbers that are not
                finite.
        """
        parent, child = parent.strip('/'), child.strip('/')
        _check(parent, child, parent_from_child)
        edge = self._edges.get(child)
        if edge is None or static or edge.static or edge.parent != parent:
            self._edges[child] = _Edge(parent, static, [stamp_ns], [parent_from_child])
            return
        if stamp_ns < edge.stamps[-1] - self._history_ns:
            edge.stamps.clear()
            edge.samples.clear()
        _insert(edge, stamp_ns, parent_from_child)
        expired = bisect_left(edge.stamps, edge.stamps[-1] - self._history_ns)
        del edge.stamps[:expired], edge.samples[:expired]

    def clear_history(self) -> None:
        """Forgets all transforms but the static ones, as when time jumped back."""
        self._edges = {child: edge for child, edge in self._edges.items() if edge.static}

    def lookup(self, target: str, source: str, stamp_ns: int) -> pycolmap.Rigid3d:
        """The transform `target_from_source` at a time, through however many frames.

        Between two samples the translation is interpolated linearly and the rotation spherically.
        Beyond the samples there is no answer: nothing is extrapolated.

        Raises:
            TransformError: An unknown frame, no connection, or no sample at that time.
        """
        target, source = target.strip('/'), source.strip('/')
        if target == source:
            return pycolmap.Rigid3d()
        target_line, source_line = self._ancestry(target), self._ancestry(source)
        shared = next((frame for frame in target_line if frame in source_line), None)
        if shared is None:
            msg = (
                f'frames `{target}` and `{source}` are not connected; the transforms received so '
                f'far are {self._describe()}'
            )
            raise TransformError(msg)
        shared_from_target = self._chain(_below(target_line, shared), stamp_ns)
        shared_from_source = self._chain(_below(source_line, shared), stamp_ns)
        return shared_from_target.inverse() * shared_from_source

    def _ancestry(self, frame: str) -> list[str]:
        """The frame, its parent, and so on to the root."""
        if frame not in self.frames:
            known = self._describe()
            msg = f'frame `{frame}` is not known; the transforms received so far are {known}'
            raise TransformError(msg)
        line = [frame]
        while (edge := self._edges.get(line[-1])) is not None:
            if edge.parent in line:
                loop = ' -> '.join([*line, edge.parent])
                msg = f'the parents of frame `{frame}` form a loop: {loop}'
                raise TransformError(msg)
            line.append(edge.parent)
        return line

    def _chain(self, frames: Iterable[str], stamp_ns: int) -> pycolmap.Rigid3d:
        """Product of the transforms of these frames to their parents, lowest frame first."""
        ancestor_from_frame = pycolmap.Rigid3d()
        for frame in frames:
            ancestor_from_frame = self._at(frame, stamp_ns) * ancestor_from_frame
        return ancestor_from_frame

    def _at(self, frame: str, stamp_ns: int) -> pycolmap.Rigid3d:
        edge = self._edges[frame]
        if edge.static:
            return edge.samples[0]
        after = bisect_left(edge.stamps, stamp_ns)
        if after < len(edge.stamps) and edge.stamps[after] == stamp_ns:
            return edge.samples[after]
        if after in {0, len(edge.stamps)}:
            msg = (
                f'no transform from `{frame}` to `{edge.parent}` at {stamp_ns / 1e9:.6f} s; it is '
                f'known from {edge.stamps[0] / 1e9:.6f} s to {edge.stamps[-1] / 1e9:.6f} s'
            )
            raise TransformError(msg)
        begin, end = edge.stamps[after - 1], edge.stamps[after]
        share = (stamp_ns - begin) / (end - begin)
        return interpolated(edge.samples[after - 1], edge.samples[after], share)

    def _describe(self) -> str:
        edges = sorted(f'{edge.parent} -> {child}' for child, edge in self._edges.items())
        return ', '.join(edges) or 'none'


def _check(parent: str, child: str, parent_from_child: pycolmap.Rigid3d) -> None:
    if not parent or not child or parent == child:
        msg = f'a transform from `{child}` to `{parent}`: expected two different names of frames'
        raise TransformError(msg)
    if not np.isfinite(parent_from_child.matrix()).all():
        msg = f'the transform from `{child}` to `{parent}` holds numbers that are not finite'
        raise TransformError(msg)


def _insert(edge: _Edge, stamp_ns: int, parent_from_child: pycolmap.Rigid3d) -> None:
    position = bisect_left(edge.stamps, stamp_ns)
    if position < len(edge.stamps) and edge.stamps[position] == stamp_ns:
        edge.samples[position] = parent_from_child
        return
    edge.stamps.insert(position, stamp_ns)
    edge.samples.insert(position, parent_from_child)


def _below(line: list[str], ancestor: str) -> list[str]:
    return line[: line.index(ancestor)]


def interpolated(
    before: pycolmap.Rigid3d, after: pycolmap.Rigid3d, share: float
) -> pycolmap.Rigid3d:
    """Between two samples: the translation linearly, the rotation spherically.

    Args:
        before: The earlier sample.
        after: The later sample.
        share: Of the way from one to the other, 0 to 1.
    """
    rotations = Rotation.concatenate([rotation_of(before), rotation_of(after)])
    rotation = Slerp([0.0, 1.0], rotations)(share)
    return rigid3d_from_rotation(
        rotation, (1.0 - share) * before.translation + share * after.translation
    )
