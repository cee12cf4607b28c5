# Copyright 2026 gam_relocalizer authors
# SPDX-License-Identifier: Apache-2.0
"""A map as a recording of rerun: points, reference cameras, covisibility, and a replayed drive.

Entities: `map/points`, `map/images/<name>`, `map/covisibility`; `drive/trajectory`, `drive/fix`,
`drive/refused`, `drive/verdict`, `drive/inliers`, and `drive/error/position` and
`drive/error/rotation_deg` where the truth is known, these over the timeline `stamp`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from scipy.sparse import triu

from gam_relocalizer.errors import UsageError
from gam_relocalizer.localization.result import Status
from gam_relocalizer.mapping.consistency import has_model
from gam_relocalizer.mapping.coverage import SHARED_POINTS
from gam_relocalizer.mapping.leave_one_out import reference_cameras
from gam_relocalizer.plots import View, upward_direction

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from types import ModuleType

    import pycolmap
    from numpy.typing import NDArray

    from gam_relocalizer.scene_map import SceneMap
    from gam_relocalizer.viewing.drive import Drive

APPLICATION = 'gam_relocalizer'
POINTS, IMAGES, COVISIBILITY = 'map/points', 'map/images', 'map/covisibility'
TRAJECTORY, FIX, REFUSED = 'drive/trajectory', 'drive/fix', 'drive/refused'
VERDICT, INLIERS = 'drive/verdict', 'drive/inliers'
ERROR = 'drive/error'
POSITION_ERROR, ROTATION_ERROR = f'{ERROR}/position', f'{ERROR}/rotation_deg'
TIMELINE = 'stamp'
# What a laptop turns smoothly.
MAX_POINTS = 500_000
MAX_IMAGES = 1000
MAX_EDGES = 5000

_FIX_COLOUR, _REFUSED_COLOUR = (11, 98, 196), (214, 39, 40)
# Cameras are drawn so large that they do not hide each other.
_CAMERA_SHARE = 0.5
# Negative: in pixels of the screen, whatever the scale of the map.
_POINT_RADIUS = -6.0


def import_rerun() -> ModuleType:
    """The viewer's library.

    Raises:
        UsageError: It is not installed.
    """
    try:
        import rerun
    except ImportError as err:
        msg = 'the 3D viewer is not installed; install it with `pip install gam_relocalizer[view]`'
        raise UsageError(msg) from err
    return rerun


def write_recording(file: Path, scene_map: SceneMap, drive: Drive | None = None) -> None:
    """Writes a map, and a drive through it, as a recording that rerun opens.

    Nothing is sent anywhere, and no viewer is started.

    Args:
        file: To be written, `.rrd`; under a temporary name first.
        scene_map: The map; large ones are thinned.
        drive: What was localized in it.

    Raises:
        UsageError: rerun is not installed, or the file cannot be written.
    """
    rerun = import_rerun()
    temporary = file.with_name(f'.{file.name}.part')
    recording = rerun.RecordingStream(APPLICATION, recording_id=scene_map.manifest.map_id)
    try:
        recording.save(temporary, default_blueprint=_blueprint(rerun, drive))
    except RuntimeError as err:
        msg = f'{file}: cannot be written: {err}'
        raise UsageError(msg) from err
    try:
        _record_map(rerun, recording, scene_map)
        if drive is not None:
            _record_drive(rerun, recording, drive)
        recording.disconnect()
        temporary.replace(file)
    finally:  # Ctrl-C too leaves nothing half-written
        temporary.unlink(missing_ok=True)


def _blueprint(rerun: Any, drive: Drive | None) -> Any:  # noqa: ANN401 - rerun comes on demand
    """What is shown where: the 3D view, and beside it what happened over time."""
    blueprint = rerun.blueprint
    scene = blueprint.Spatial3DView(origin='/', name='map')
    if drive is None:
        return blueprint.Blueprint(scene, collapse_panels=True)
    over_time = [blueprint.TimeSeriesView(origin=INLIERS, name='inliers')]
    if any(one.error for one in drive.attempts):
        over_time += [
            blueprint.TimeSeriesView(origin=POSITION_ERROR, name='position error'),
            blueprint.TimeSeriesView(origin=ROTATION_ERROR, name='rotation error [deg]'),
        ]
    over_time.append(blueprint.TextLogView(origin=VERDICT, name='verdicts'))
    return blueprint.Blueprint(
        blueprint.Horizontal(scene, blueprint.Vertical(*over_time), column_shares=[3, 1]),
        collapse_panels=True,
    )


def _record_map(rerun: Any, recording: Any, scene_map: SceneMap) -> None:  # noqa: ANN401
    recording.log('/', _upright(rerun, scene_map), static=True)
    points = scene_map.some_points(MAX_POINTS)
    recording.log(
        POINTS,
        rerun.Points3D(
            points, colors=_by_height(points, scene_map), radii=rerun.Radius.ui_points(1.5)
        ),
        static=True,
    )
    _record_cameras(rerun, recording, scene_map)
    _record_covisibility(rerun, recording, scene_map)


def _record_cameras(rerun: Any, recording: Any, scene_map: SceneMap) -> None:  # noqa: ANN401
    """Frusta; arrows of the way they look where the map comes without the model that knows more."""
    step = max(1, -(-scene_map.num_images // MAX_IMAGES))
    size = _camera_size(scene_map)
    if has_model(scene_map):
        cameras = reference_cameras(scene_map)
        for image in range(0, scene_map.num_images, step):
            _record_camera(rerun, recording, scene_map, image, cameras[image], size)
        return
    ahead = np.array([pose.rotation.matrix()[2] for pose in scene_map.camera_from_map])
    arrows = rerun.Arrows3D(
        origins=scene_map.camera_positions[::step], vectors=size * ahead[::step]
    )
    recording.log(IMAGES, arrows, static=True)


def _upright(rerun: Any, scene_map: SceneMap) -> Any:  # noqa: ANN401
    """Which axis of the map points up, as near as that."""
    up = upward_direction(scene_map)
    axis = 2 if up is None else int(np.argmax(np.abs(up)))
    way = 'UP' if up is None or up[axis] > 0 else 'DOWN'
    return getattr(rerun.ViewCoordinates, f'RIGHT_HAND_{"XYZ"[axis]}_{way}')


def _by_height(points: NDArray[np.float64], scene_map: SceneMap) -> NDArray[np.uint8]:
    heights = points @ np.cross(*View.from_above(scene_map).axes)
    if not len(heights):
        return np.empty((0, 3), np.uint8)
    low, high = np.quantile(heights, [0.02, 0.98])
    shares = np.clip((heights - low) / max(high - low, 1e-12), 0.0, 1.0)
    return np.asarray(colormaps['viridis'](shares)[:, :3] * 255.0, np.uint8)


def _camera_size(scene_map: SceneMap) -> float:
    """How far from a camera its image is drawn [map units]."""
    positions = scene_map.camera_positions
    apart = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    moving = apart[apart > 0.0]
    depths = [
        float(np.median((pose * scene_map.positions_of(seen))[:, 2]))
        for image, pose in enumerate(scene_map.camera_from_map)
        if len(seen := scene_map.points_seen_by(image))
    ]
    step = float(np.median(moving)) if len(moving) else np.inf
    depth = float(np.median(depths)) if depths else 1.0
    return float(np.clip(_CAMERA_SHARE * step, 0.01 * depth, 0.1 * depth))


def _record_camera(
    rerun: Any,  # noqa: ANN401
    recording: Any,  # noqa: ANN401
    scene_map: SceneMap,
    image: int,
    camera: pycolmap.Camera,
    size: float,
) -> None:
    """A frustum; of a distorted or fisheye camera that of the pinhole in its middle."""
    map_from_camera = scene_map.camera_from_map[image].inverse()
    recording.log(
        rerun.new_entity_path([*IMAGES.split('/'), scene_map.image_names[image]]),
        rerun.Transform3D(
            translation=map_from_camera.translation, mat3x3=map_from_camera.rotation.matrix()
        ),
        rerun.Pinhole(
            image_from_camera=camera.calibration_matrix(),
            width=camera.width,
            height=camera.height,
            image_plane_distance=size,
        ),
        static=True,
    )


def _record_covisibility(rerun: Any, recording: Any, scene_map: SceneMap) -> None:  # noqa: ANN401
    """The edges between images that share most points."""
    shared = triu(scene_map.covisibility, k=1).tocoo()
    enough = np.flatnonzero(shared.data >= SHARED_POINTS)
    strongest = enough[np.argsort(-shared.data[enough], kind='stable')[:MAX_EDGES]]
    if not len(strongest):
        return
    positions = scene_map.camera_positions
    strips = np.stack([positions[shared.row[strongest]], positions[shared.col[strongest]]], axis=1)
    shares = shared.data[strongest] / shared.data[strongest[0]]
    colours = np.asarray(colormaps['plasma'](shares)[:, :3] * 255.0, np.uint8)
    recording.log(
        COVISIBILITY,
        rerun.LineStrips3D(strips, colors=colours, radii=rerun.Radius.ui_points(0.5)),
        static=True,
    )


def _record_drive(rerun: Any, recording: Any, drive: Drive) -> None:  # noqa: ANN401
    places: Sequence[NDArray[np.float64]] = [
        one.map_from_base.translation for one in drive.fixes if one.map_from_base is not None
    ]
    if len(places) > 1:
        recording.log(
            TRAJECTORY, rerun.LineStrips3D([np.array(places)], colors=[_FIX_COLOUR]), static=True
        )
    for attempt in drive.attempts:
        recording.set_time(TIMELINE, timestamp=np.datetime64(attempt.stamp_ns, 'ns'))
        recording.log(INLIERS, rerun.Scalars(attempt.inliers))
        if attempt.error is not None:
            recording.log(POSITION_ERROR, rerun.Scalars(attempt.error.position))
            recording.log(ROTATION_ERROR, rerun.Scalars(attempt.error.rotation_deg))
        if attempt.map_from_base is not None:
            place = attempt.map_from_base
            recording.log(
                FIX,
                rerun.Transform3D(translation=place.translation, mat3x3=place.rotation.matrix()),
                rerun.TransformAxes3D(0.5),
                rerun.Points3D([[0.0, 0.0, 0.0]], colors=[_FIX_COLOUR], radii=_POINT_RADIUS),
            )
            recording.log(REFUSED, rerun.Clear(recursive=False))
        elif (guess := drive.guessed_position(attempt.stamp_ns)) is not None:
            recording.log(
                REFUSED, rerun.Points3D([guess], colors=[_REFUSED_COLOUR], radii=_POINT_RADIUS)
            )
        level = 'INFO' if attempt.status is Status.ACCEPTED else 'WARN'
        text = f'{attempt.status.name}: {attempt.reason}'
        recording.log(VERDICT, rerun.TextLog(text, level=level))
