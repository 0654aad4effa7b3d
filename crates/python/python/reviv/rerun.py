"""A reconstruction in `Rerun <https://rerun.io>`_: ``python -m reviv.rerun FOLDER`` writes ``scene.rrd`` into it.

Needs the Rerun SDK beside ``reviv``: ``pip install rerun-sdk``. From Python, :meth:`reviv.Reconstruction.to_rerun` writes the file, and
:func:`log` sends everything to a recording of your own, such as a viewer that ``rerun.init("reviv", spawn=True)`` has opened.

=============================  ==========================================================================================
entity                         holds
=============================  ==========================================================================================
``world/camera``               the head camera: camera to world, metres, z up
``world/camera/image``         the pictures that the model saw, in a pinhole; below it ``gaze`` and, where metric, ``depth``
``world/path``                 the whole path of the camera
``world/body``                 21 named joints with their bones
``world/camera/left_hand``     the same of the hands, in the camera
``depth``                      depth of unknown scale, a picture beside the world
``certainty/body``, ...        token certainty; not an accuracy
``signals/head_imu``, ...      every other modality
``about``                      what was assumed
=============================  ==========================================================================================

The timeline is ``seconds``, from the start of the reconstruction.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Sequence

import numpy as np

from ._error import refused
from ._reviv import Error

if TYPE_CHECKING:
    from ._parts import Joints
    from ._reconstruction import Reconstruction

#: The name of the file in a reconstruction folder.
FILE = "scene.rrd"
TIMELINE = "seconds"
_COLOURS = {"body": (120, 220, 140), "left_hand": (70, 170, 255), "right_hand": (255, 110, 70)}
_RADIUS = {"body": 0.015, "left_hand": 0.005, "right_hand": 0.005}


def _sdk() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise refused(f"the Rerun SDK is not installed in this Python: {error}", "pip install rerun-sdk") from error
    if not hasattr(rerun.RecordingStream, "send_columns"):
        raise refused(f"the Rerun SDK {rerun.__version__} is too old", "pip install --upgrade rerun-sdk")
    return rerun


def write(reconstruction: Reconstruction, path: str | os.PathLike[str]) -> Path:
    """Writes a reconstruction as an ``.rrd`` file, which ``rerun FILE`` opens.

    Raises :class:`reviv.Error` where the Rerun SDK is not installed.
    """
    rr = _sdk()
    target = Path(path)
    recording = rr.RecordingStream("reviv")
    try:
        recording.save(target, default_blueprint=_blueprint(reconstruction))
    except Exception as error:
        raise refused(f"{target}: {error}", "name a file in a folder that is there") from error
    log(reconstruction, recording)
    # The file is whole when the stream is closed.
    recording.flush()
    recording.disconnect()
    return target


def log(reconstruction: Reconstruction, recording: Any = None) -> None:
    """Sends a reconstruction to a ``rerun.RecordingStream``; without one, to the recording that ``rerun.init`` began."""
    rr = _sdk()
    stream = recording if recording is not None else rr.get_global_data_recording()
    if stream is None:
        raise refused("there is no recording to send to", 'rerun.init("reviv", spawn=True)')
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True, strict=True)
    _about(rr, stream, reconstruction)
    if "camera" in reconstruction:
        _camera(rr, stream, reconstruction)
    if "body" in reconstruction:
        _joints(rr, stream, "world/body", reconstruction.body)
    for name in ("left_hand", "right_hand"):
        if name in reconstruction:
            _joints(rr, stream, f"world/camera/{name}", getattr(reconstruction, name))
    if "gaze" in reconstruction:
        _gaze(rr, stream, reconstruction)
    _pictures(rr, stream, reconstruction)
    if "depth" in reconstruction:
        _depth(rr, stream, reconstruction)
    for name, values in reconstruction.certainty.items():
        _scalars(rr, stream, f"certainty/{name}", values[:, None], reconstruction.rate, [name])
    for name, signal in reconstruction.signals.items():
        _scalars(rr, stream, f"signals/{name}", signal.values, signal.rate, list(signal.channels))


def _times(rr: Any, count: int, rate: float) -> list[Any]:
    return [rr.TimeColumn(TIMELINE, duration=np.arange(count) / rate)]


def _about(rr: Any, stream: Any, reconstruction: Reconstruction) -> None:
    lines = [f"# {reconstruction.title}", ""]
    lines += [f"* **{label}**: {value}" for label, value in reconstruction.assumptions.items()]
    text = rr.TextDocument("\n".join(lines), media_type="text/markdown")
    stream.log("about", text, static=True, strict=True)


def _camera(rr: Any, stream: Any, reconstruction: Reconstruction) -> None:
    camera = reconstruction.camera
    poses = camera.T_world_camera
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], mat3x3=poses[:, :3, :3])
    stream.send_columns("world/camera", indexes=_times(rr, len(poses), camera.rate), columns=columns, strict=True)
    # The centre of the top left pixel is (0.5, 0.5) there, and (0, 0) here.
    image_from_camera = camera.K.copy()
    image_from_camera[:2, 2] += 0.5
    pinhole = rr.Pinhole(
        image_from_camera=image_from_camera,
        resolution=camera.size,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.25,
    )
    stream.log("world/camera/image", pinhole, static=True, strict=True)
    path = rr.LineStrips3D([camera.positions], colors=[(160, 160, 160)])
    stream.log("world/path", path, static=True, strict=True)


def _joints(rr: Any, stream: Any, entity: str, joints: Joints) -> None:
    colour = _COLOURS[joints.modality]
    about = rr.ClassDescription(
        info=rr.AnnotationInfo(id=0, label=joints.modality, color=colour),
        keypoint_annotations=[rr.AnnotationInfo(id=i, label=name) for i, name in enumerate(joints.names)],
        keypoint_connections=[(parent, i) for i, parent in enumerate(joints.parents) if parent != i],
    )
    stream.log(entity, rr.AnnotationContext([about]), static=True, strict=True)
    constant = rr.Points3D.from_fields(class_ids=0, radii=_RADIUS[joints.modality], show_labels=False, colors=[colour])
    stream.log(entity, constant, static=True, strict=True)
    # A joint that is unknown is left out; bones are drawn between those that are there.
    known = joints.valid
    numbers = np.broadcast_to(np.arange(known.shape[1]), known.shape)
    columns = rr.Points3D.columns(positions=joints.positions[known], keypoint_ids=numbers[known])
    lengths = known.sum(axis=1)
    times = _times(rr, len(joints), joints.rate)
    stream.send_columns(entity, indexes=times, columns=columns.partition(lengths), strict=True)


def _gaze(rr: Any, stream: Any, reconstruction: Reconstruction) -> None:
    gaze = reconstruction.gaze
    known = gaze.valid
    entity = "world/camera/image/gaze"
    stream.log(entity, rr.Points2D.from_fields(colors=[(255, 230, 0)], radii=[-6.0]), static=True, strict=True)
    columns = rr.Points2D.columns(positions=gaze.pixels[known] + 0.5)
    times = _times(rr, len(gaze), gaze.rate)
    stream.send_columns(entity, indexes=times, columns=columns.partition(known.astype(int)), strict=True)


def _pictures(rr: Any, stream: Any, reconstruction: Reconstruction) -> None:
    pictures = reconstruction.pictures
    for index, jpeg in enumerate(pictures.jpegs):
        stream.set_time(TIMELINE, duration=index / pictures.rate)
        image = rr.EncodedImage(contents=jpeg, media_type="image/jpeg")
        stream.log("world/camera/image", image, strict=True)
    stream.reset_time()


def _depth(rr: Any, stream: Any, reconstruction: Reconstruction) -> None:
    depth = reconstruction.depth
    for index, values in enumerate(depth.values):
        stream.set_time(TIMELINE, duration=index / depth.rate)
        if depth.metric:
            # Millimetres take half the space; 0 is unknown.
            known = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
            millimetres = np.clip(np.rint(1000 * known), 0, np.iinfo(np.uint16).max).astype(np.uint16)
            stream.log("world/camera/image/depth", rr.DepthImage(millimetres, meter=1000.0), strict=True)
        else:
            # Without a scale it has no place in the world.
            stream.log("depth", rr.DepthImage(np.asarray(values, dtype=np.float32)), strict=True)
    stream.reset_time()


def _scalars(rr: Any, stream: Any, entity: str, values: np.ndarray, rate: float, names: list[str]) -> None:
    samples, channels = values.shape
    if len(names) == channels:
        stream.log(entity, rr.SeriesLines(names=names), static=True, strict=True)
    flat = np.asarray(values, dtype=np.float64).reshape(-1)
    columns = rr.Scalars.columns(scalars=flat).partition(np.full(samples, channels))
    stream.send_columns(entity, indexes=_times(rr, samples, rate), columns=columns, strict=True)


def _blueprint(reconstruction: Reconstruction) -> Any:
    import rerun.blueprint as rrb

    beside: list[Any] = [rrb.Spatial2DView(origin="world/camera/image", name="seen")]
    if "depth" in reconstruction and not reconstruction.depth.metric:
        beside.append(rrb.Spatial2DView(origin="depth", name="depth, no scale"))
    below: list[Any] = [rrb.TimeSeriesView(origin="certainty", name="token certainty")]
    below += [rrb.TimeSeriesView(origin=f"signals/{name}", name=name) for name in reconstruction.signals]
    below.append(rrb.TextDocumentView(origin="about", name="assumed"))
    world = rrb.Spatial3DView(origin="world", name="world")
    views = rrb.Horizontal(world, rrb.Vertical(*beside, rrb.Tabs(*below)), column_shares=[3, 2])
    return rrb.Blueprint(views, rrb.TimePanel(timeline=TIMELINE))


def main(arguments: Sequence[str] | None = None) -> int:
    """``python -m reviv.rerun FOLDER [-o FILE]``; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m reviv.rerun", description="Write a reconstruction folder as a recording of Rerun."
    )
    parser.add_argument("folder", nargs="?", type=Path, help="what `reviv reconstruct` made")
    parser.add_argument("-o", "--output", type=Path, help=f"the file to write (default: {FILE} in the folder)")
    parser.add_argument("--check", action="store_true", help="only say whether the Rerun SDK is there")
    asked = parser.parse_args(arguments)
    try:
        if asked.check:
            print(f"rerun-sdk {_sdk().__version__}")
            return 0
        if asked.folder is None:
            parser.error("give the folder of a reconstruction")
        from ._reconstruction import open

        _sdk()
        print(write(open(asked.folder), asked.output or asked.folder / FILE))
    except Error as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
