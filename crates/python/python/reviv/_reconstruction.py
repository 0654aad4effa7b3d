"""A reconstruction: from a video, or from a folder made earlier."""

from __future__ import annotations

import csv
import html
import json
import os
import shutil
from functools import cached_property
from pathlib import Path
from typing import Any, Iterator, Mapping, Protocol

import numpy as np

from . import _reviv
from ._model import Model, load
from ._progress import Progress, callback

_WORLD = "world: z up, metres, origin and heading of the first camera"
_CAMERA = "camera of the same sample: x right, y down, z forward, metres"
_IMAGE = "upright square image"
_CONFIDENCE = "confidence.npz"


class Absent(_reviv.Error, AttributeError):
    """What was asked for is not part of this reconstruction."""


class _Source(Protocol):
    """Where the arrays are: in memory, or in a folder."""

    rate: float

    def manifest(self) -> str: ...
    def joints(self, modality: str) -> np.ndarray | None: ...
    def camera(self) -> np.ndarray | None: ...
    def gaze(self) -> np.ndarray | None: ...
    def depth(self) -> tuple[np.ndarray, float] | None: ...
    def confidence(self) -> dict[str, np.ndarray]: ...
    def signals(self) -> dict[str, tuple[np.ndarray, float, list[str], list[str]]]: ...
    def page(self) -> str: ...
    def write(self, folder: str) -> None: ...


class _Folder:
    """A reconstruction folder. Arrays are read when they are asked for."""

    rate = 30.0

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._manifest: dict[str, Any] = json.loads((path / "manifest.json").read_text("utf-8"))
            entries = self._manifest["arrays"]
            # Confidence is named after what it is of.
            self._arrays = {entry["name"]: entry for entry in entries if entry["file"] != _CONFIDENCE}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise _reviv.Error(
                f"{path}: no reconstruction: {error}\n"
                "hint: give the folder that `reviv reconstruct` made, with its `manifest.json`"
            ) from error

    def _read(self, name: str) -> np.ndarray | None:
        entry = self._arrays.get(name)
        return None if entry is None else self._of(entry["file"], name)

    def _of(self, file: str, name: str) -> np.ndarray | None:
        path = self.path / file
        try:
            with np.load(path, allow_pickle=False) as arrays:
                array = arrays[name] if name in arrays.files else None
        except (OSError, ValueError) as error:
            raise _reviv.Error(f"{path}: {error}") from error
        if array is not None:
            array.flags.writeable = False
        return array

    def manifest(self) -> str:
        return json.dumps(self._manifest)

    def joints(self, modality: str) -> np.ndarray | None:
        return self._read(modality)

    def camera(self) -> np.ndarray | None:
        return self._read("T_world_camera")

    def gaze(self) -> np.ndarray | None:
        if "gaze" in self._arrays:
            return self._of("gaze.npz", "gaze")
        # Folders of version 0.1 have the table alone.
        table = self.path / "gaze.csv"
        if not table.is_file():
            return None
        with table.open(newline="", encoding="utf-8") as lines:
            rows = [(float(row["x"] or "nan"), float(row["y"] or "nan")) for row in csv.DictReader(lines)]
        return np.array(rows, dtype=np.float32).reshape(-1, 2)

    def depth(self) -> tuple[np.ndarray, float] | None:
        for name in ("metres", "relative"):
            values = self._read(name)
            if values is not None:
                return values, float(self._arrays[name]["rate"])
        return None

    def confidence(self) -> dict[str, np.ndarray]:
        found = {}
        for entry in self._manifest["arrays"]:
            if entry["file"] == _CONFIDENCE:
                values = self._of(entry["file"], entry["name"])
                if values is not None:
                    found[entry["name"]] = values
        return found

    def signals(self) -> dict[str, tuple[np.ndarray, float, list[str], list[str]]]:
        own = {"body.npz", "hands.npz", "camera.npz", "gaze.npz", "depth.npz", _CONFIDENCE}
        found = {}
        for entry in self._manifest["arrays"]:
            name = entry["name"]
            if entry["file"] in own or name.endswith("_valid"):
                continue
            values = self._of(entry["file"], name)
            if values is not None and values.ndim == 2:
                found[name] = (values, float(entry["rate"]), [], entry["unit"].split())
        return found

    def page(self) -> str:
        return (self.path / "view.html").read_text("utf-8")

    def write(self, folder: str) -> None:
        target = Path(folder)
        for name in self._manifest["files"]:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self.path / name, target / name)


def _names(names: tuple[str, ...]) -> str:
    return ", ".join(names) if names else "nothing"


class Joints:
    """21 named joints over time: the body in the world, or a hand in the camera of the same sample."""

    def __init__(self, modality: str, positions: np.ndarray, rate: float, confidence: np.ndarray | None) -> None:
        names, parents = _reviv.skeleton(modality)
        self.modality = modality
        #: ``[samples, 21, 3]``, metres, read-only; NaN where unknown.
        self.positions: np.ndarray = positions
        #: The joints' names, in the order of ``positions``.
        self.names: tuple[str, ...] = tuple(names)
        #: Per joint the one nearer to the root; the root is its own parent.
        self.parents: tuple[int, ...] = tuple(parents)
        #: Samples per second.
        self.rate: float = rate
        #: The frame of reference, in words.
        self.frame: str = _WORLD if modality == "body" else _CAMERA
        #: ``[samples]``, 0 (a guess) to 1 (certain), by the entropy of the tokens. Not an accuracy.
        self.confidence: np.ndarray | None = confidence

    @property
    def valid(self) -> np.ndarray:
        """``[samples, 21]``: which joints are known."""
        return np.isfinite(self.positions).all(axis=-1)

    def position(self, joint: str, seconds: float) -> np.ndarray:
        """Where a joint is, ``[3]`` metres: linear between the samples around ``seconds``."""
        if joint not in self.names:
            raise _reviv.Error(f"no joint `{joint}`\nhint: {', '.join(self.names)}")
        length = len(self.positions) / self.rate
        if not 0 <= seconds <= length:
            raise _reviv.Error(f"{seconds} s lies outside the recording of {length} s")
        track = self.positions[:, self.names.index(joint)]
        at = min(seconds * self.rate, len(track) - 1)
        before = int(at)
        after, share = min(before + 1, len(track) - 1), at - before
        # An unknown neighbour does not matter exactly at a sample.
        return track[before].copy() if share == 0 else (1 - share) * track[before] + share * track[after]

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        known = 100 * float(self.valid.mean()) if len(self) else 0.0
        return (
            f"<{self.modality}: {len(self)} samples of {len(self.names)} joints at {self.rate:g} Hz, "
            f"{known:.0f} % known, in the {self.frame}>"
        )


class CameraPath:
    """The head camera over time."""

    def __init__(self, poses: np.ndarray, rate: float, intrinsics: Mapping[str, float]) -> None:
        #: ``[samples, 4, 4]``: camera to world, metres; the camera looks along z, x right, y down.
        self.T_world_camera: np.ndarray = poses
        #: Samples per second.
        self.rate: float = rate
        #: The frame of reference, in words.
        self.frame: str = _WORLD
        #: Width and height of the square frames that the model saw, pixels.
        self.size: tuple[int, int] = (int(intrinsics["width"]), int(intrinsics["height"]))
        #: ``[3, 3]`` pinhole intrinsics of those frames; the centre of the top left pixel is (0, 0).
        self.K: np.ndarray = np.array(
            [[intrinsics["fx"], 0, intrinsics["cx"]], [0, intrinsics["fy"], intrinsics["cy"]], [0, 0, 1]],
            dtype=np.float64,
        )

    @property
    def positions(self) -> np.ndarray:
        """``[samples, 3]``: where it is in the world, metres."""
        return self.T_world_camera[:, :3, 3]

    def __len__(self) -> int:
        return len(self.T_world_camera)

    def __repr__(self) -> str:
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return f"<camera: {len(self)} samples at {self.rate:g} Hz, a path of {steps.sum():.2f} m>"


class Gaze:
    """Where the wearer looks."""

    def __init__(self, points: np.ndarray, rate: float, size: tuple[int, int], confidence: np.ndarray | None) -> None:
        #: ``[samples, 2]``: x right and y down as shares of the upright square image; NaN where unknown.
        self.points: np.ndarray = points
        #: Samples per second.
        self.rate: float = rate
        #: The frame of reference, in words.
        self.frame: str = _IMAGE
        #: Width and height of the square frames that the model saw, pixels.
        self.size: tuple[int, int] = size
        #: ``[samples]``, 0 (a guess) to 1 (certain). Not an accuracy.
        self.confidence: np.ndarray | None = confidence

    @property
    def pixels(self) -> np.ndarray:
        """``[samples, 2]``: in pixels of the square frames; the centre of the top left pixel is (0, 0)."""
        return self.points * np.array(self.size, dtype=self.points.dtype) - self.points.dtype.type(0.5)

    @property
    def valid(self) -> np.ndarray:
        """``[samples]``: where it is known."""
        return np.isfinite(self.points).all(axis=-1)

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"<gaze: {len(self)} samples at {self.rate:g} Hz in the {self.frame}>"


class Depth:
    """Depth along the optical axis over the square image, one map per frame of the model's video."""

    def __init__(self, values: np.ndarray, rate: float, manifest: Mapping[str, Any]) -> None:
        #: ``[frames, height, width]``: metres where ``metric``, else of unknown scale and shift.
        self.values: np.ndarray = values
        #: Frames per second.
        self.rate: float = rate
        #: Whether ``values`` are metres, and by what: ``metric by floor fit``, ``relative``.
        self.scale: str = _scale(manifest["scale"])
        #: Whether ``values`` are metres.
        self.metric: bool = manifest.get("fit") is not None
        #: The fit that made depth metric.
        self.fit: dict[str, float] | None = manifest.get("fit")
        #: Why depth stayed relative.
        self.refused: str | None = manifest.get("refused")

    @property
    def metres(self) -> np.ndarray:
        """``[frames, height, width]`` metres; refused where depth is relative."""
        if not self.metric:
            raise Absent(
                f"depth is relative: {self.refused}\nhint: `values` has it up to scale and shift; `anchor=` gives it a scale"
            )
        return self.values

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        frames, height, width = self.values.shape
        return f"<depth: {frames} maps of {height} x {width} at {self.rate:g} Hz, {self.scale}>"


class Signal:
    """A modality without a type of its own: channels over time."""

    def __init__(self, name: str, values: np.ndarray, rate: float, channels: list[str], units: list[str]) -> None:
        self.name = name
        #: ``[samples, channels]``; NaN where unknown.
        self.values: np.ndarray = values
        #: Samples per second.
        self.rate: float = rate
        #: The channels' names, where they are known.
        self.channels: tuple[str, ...] = tuple(channels)
        #: One unit per channel, or one for all.
        self.units: tuple[str, ...] = tuple(units)

    def __repr__(self) -> str:
        samples, channels = self.values.shape
        return f"<{self.name}: {samples} samples of {channels} channels at {self.rate:g} Hz>"


def _scale(status: Any) -> str:
    if isinstance(status, Mapping):
        inner = status.get("metric", status)
        return f"metric by {inner['by']}" if isinstance(inner, Mapping) and "by" in inner else str(status)
    return "no length" if status == "none" else str(status)


class Reconstruction:
    """The wearer and the world of one video.

    The world has z up, metres, and the origin and heading of the first camera. Body, hands, gaze and camera have 30 samples a
    second; depth has a map per frame of the model's video.
    """

    def __init__(self, source: _Source) -> None:
        self._source = source
        #: What the folder's ``manifest.json`` says.
        self.manifest: dict[str, Any] = json.loads(source.manifest())

    @property
    def title(self) -> str:
        """The recording's name."""
        return str(self.manifest["title"])

    @property
    def seconds(self) -> float:
        """How long it is."""
        return float(self.manifest["seconds"])

    @property
    def assumptions(self) -> dict[str, str]:
        """What was assumed, and where it came from."""
        return {label: value for label, value in self.manifest["assumptions"]}

    @cached_property
    def confidence(self) -> dict[str, np.ndarray]:
        """By modality ``[samples]``, 0 (a guess) to 1 (certain), by the entropy of the tokens. Not an accuracy."""
        return self._source.confidence()

    def _joints(self, modality: str) -> Joints:
        positions = self._source.joints(modality)
        if positions is None:
            raise self._absent(modality)
        return Joints(modality, positions, self._source.rate, self.confidence.get(modality))

    def _absent(self, modality: str) -> Absent:
        return Absent(f"`{modality}` was not reconstructed\nhint: there is {_names(self.modalities)}")

    @cached_property
    def body(self) -> Joints:
        """The body, in the world."""
        return self._joints("body")

    @cached_property
    def left_hand(self) -> Joints:
        """The left hand, in the camera of the same sample."""
        return self._joints("left_hand")

    @cached_property
    def right_hand(self) -> Joints:
        """The right hand, in the camera of the same sample."""
        return self._joints("right_hand")

    @cached_property
    def camera(self) -> CameraPath:
        """The head camera, in the world."""
        poses = self._source.camera()
        if poses is None:
            raise self._absent("camera")
        return CameraPath(poses, self._source.rate, self.manifest["intrinsics"])

    @cached_property
    def gaze(self) -> Gaze:
        """Where the wearer looks."""
        points = self._source.gaze()
        if points is None:
            raise self._absent("gaze")
        lens = self.manifest["intrinsics"]
        size = (int(lens["width"]), int(lens["height"]))
        return Gaze(points, self._source.rate, size, self.confidence.get("gaze"))

    @cached_property
    def depth(self) -> Depth:
        """Depth of every frame that the model saw."""
        found = self._source.depth()
        if found is None:
            raise self._absent("depth")
        return Depth(*found, self.manifest)

    @cached_property
    def signals(self) -> dict[str, Signal]:
        """Every other modality, by name."""
        return {name: Signal(name, *parts) for name, parts in self._source.signals().items()}

    @cached_property
    def modalities(self) -> tuple[str, ...]:
        """What was reconstructed."""
        source = self._source
        built_in = {
            "camera": lambda: source.camera(),
            "gaze": lambda: source.gaze(),
            "left_hand": lambda: source.joints("left_hand"),
            "right_hand": lambda: source.joints("right_hand"),
            "body": lambda: source.joints("body"),
        }
        found = [name for name, read in built_in.items() if read() is not None]
        if self.manifest["scale"] not in (None, "none"):
            found.append("depth")
        return (*found, *self.signals)

    def __contains__(self, modality: object) -> bool:
        return modality in self.modalities

    def __iter__(self) -> Iterator[str]:
        return iter(self.modalities)

    def page(self) -> str:
        """The page: one HTML text that needs no network."""
        return self._source.page()

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Writes arrays, exports and the page ``view.html``; returns the path of the page."""
        path = Path(folder)
        self._source.write(os.fspath(path))
        return path / "view.html"

    def __repr__(self) -> str:
        lines = [f"<reconstruction of `{self.title}`, {self.seconds:.2f} s: {_names(self.modalities)}"]
        lines += [f"  {label}: {value}" for label, value in self.assumptions.items()]
        if "depth" in self:
            lines.append(f"  Depth: {_scale(self.manifest['scale'])}")
        return "\n".join(lines) + ">"

    def _repr_html_(self) -> str:
        page = html.escape(self.page(), quote=True)
        return (
            f'<iframe srcdoc="{page}" sandbox="allow-scripts" title="{html.escape(self.title, quote=True)}" '
            'style="width: 100%; height: 640px; border: 0"></iframe>'
        )


def reconstruct(
    video: str | os.PathLike[str],
    model: Model | str | os.PathLike[str] | None = None,
    *,
    device: str = "cpu",
    decoding: str | None = None,
    start: float = 0.0,
    seconds: float | None = None,
    inputs: list[str] | None = None,
    targets: list[str] | None = None,
    overlap: float = 1.0,
    fov: float | None = None,
    anchor: str | os.PathLike[str] | None = None,
    seed: int = 0,
    progress: Progress = None,
    runs: str | os.PathLike[str] = "runs",
) -> Reconstruction:
    """Reconstructs the wearer and the world of a video; nothing is written.

    ``model`` is a :class:`Model`, a model folder, or a run that trained one; without it, the model of the latest run in ``runs``.
    ``decoding`` names how tokens are generated (``fast``, ``paper``, ...), ``fov`` is the horizontal field of view of the centre
    square in degrees, ``anchor`` metric depth of another model to take the scale from. ``progress`` is True for a bar, or a callable
    that hears ``(done, total, "windows")`` and stops the work by returning False.

    Raises :class:`Error` with the words of the command line, and :class:`Stopped` where the callback stopped it.
    """
    opened = model if isinstance(model, Model) else load(model, device=device, runs=runs)
    made = _reviv.reconstruct(
        os.fspath(video),
        opened._native,
        decoding,
        start,
        seconds,
        inputs or [],
        targets or [],
        overlap,
        fov,
        None if anchor is None else os.fspath(anchor),
        seed,
        callback(progress),
    )
    return Reconstruction(made)


def open(folder: str | os.PathLike[str]) -> Reconstruction:  # noqa: A001
    """A reconstruction from the folder that :meth:`Reconstruction.write` or ``reviv reconstruct`` made."""
    return Reconstruction(_Folder(Path(folder)))
