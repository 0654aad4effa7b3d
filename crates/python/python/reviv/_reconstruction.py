"""A reconstruction: from a video, or from a folder made earlier."""

from __future__ import annotations

import base64
import csv
import html
import json
import os
import re
import shutil
from functools import cached_property
from pathlib import Path
from typing import Any, Iterator, Mapping, Protocol

import numpy as np

from . import _reviv
from ._error import Absent, refused
from ._model import Model, load
from ._parts import CameraPath, Depth, Gaze, Joints, Pictures, Signal, scale_words
from ._progress import Progress, callback

_CERTAINTY = "certainty.npz"
#: Holds arrays with the names of those of the reconstruction itself.
_SAMPLES = "samples.npz"


class _Source(Protocol):
    """Where the arrays are: in memory, or in a folder."""

    rate: float

    def manifest(self) -> str: ...
    def joints(self, modality: str) -> np.ndarray | None: ...
    def camera(self) -> np.ndarray | None: ...
    def gaze(self) -> np.ndarray | None: ...
    def depth(self) -> tuple[np.ndarray, float] | None: ...
    def certainty(self) -> dict[str, np.ndarray]: ...
    def signals(self) -> dict[str, tuple[np.ndarray, float, list[str], list[str]]]: ...
    def samples(self) -> dict[str, np.ndarray]: ...
    def spread(self) -> dict[str, np.ndarray]: ...
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
            # Certainty and samples are named after what they are of.
            self._arrays = {
                entry["name"]: entry for entry in entries if entry["file"] not in (_CERTAINTY, _SAMPLES)
            }
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise refused(
                f"{path}: no reconstruction: {error}",
                "give the folder that `reviv reconstruct` made, with its `manifest.json`",
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
            raise refused(f"{path}: {error}", "reconstruct it again") from error
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

    def certainty(self) -> dict[str, np.ndarray]:
        found = {}
        for entry in self._manifest["arrays"]:
            if entry["file"] == _CERTAINTY:
                values = self._of(entry["file"], entry["name"])
                if values is not None:
                    found[entry["name"]] = values
        return found

    def signals(self) -> dict[str, tuple[np.ndarray, float, list[str], list[str]]]:
        own = {"body.npz", "hands.npz", "camera.npz", "gaze.npz", "depth.npz", _CERTAINTY, _SAMPLES}
        found: dict[str, tuple[np.ndarray, float, list[str], list[str]]] = {}
        for entry in self._manifest["arrays"]:
            name = entry["name"]
            if entry["file"] in own or name.endswith("_valid"):
                continue
            values = self._of(entry["file"], name)
            if values is not None and values.ndim == 2:
                found[name] = (values, float(entry["rate"]), [], entry["unit"].split())
        return found

    def _of_samples(self) -> dict[str, np.ndarray]:
        names = [entry["name"] for entry in self._manifest["arrays"] if entry["file"] == _SAMPLES]
        found = {name: self._of(_SAMPLES, name) for name in names}
        return {name.replace("T_world_camera", "camera"): a for name, a in found.items() if a is not None}

    def samples(self) -> dict[str, np.ndarray]:
        return {name: array for name, array in self._of_samples().items() if not name.endswith("_spread")}

    def spread(self) -> dict[str, np.ndarray]:
        found = self._of_samples().items()
        return {name.removesuffix("_spread"): array for name, array in found if name.endswith("_spread")}

    def page(self) -> str:
        path = self.path / "view.html"
        try:
            return path.read_text("utf-8")
        except (OSError, ValueError) as error:
            raise refused(f"{path}: {error}", "reconstruct it again") from error

    def write(self, folder: str) -> None:
        target = Path(folder)
        for name in self._manifest["files"]:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(self.path / name, target / name)


def _names(names: tuple[str, ...]) -> str:
    return ", ".join(names) if names else "nothing"


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
    def rate(self) -> float:
        """Samples per second of camera, gaze, hands, body and certainty."""
        return self._source.rate

    @property
    def assumptions(self) -> dict[str, str]:
        """What was assumed, and where it came from."""
        return {label: value for label, value in self.manifest["assumptions"]}

    @cached_property
    def certainty(self) -> dict[str, np.ndarray]:
        """By modality ``[samples]``, 0 (a guess) to 1 (certain), by the entropy of the tokens. Not an accuracy."""
        return self._source.certainty()

    def _joints(self, modality: str) -> Joints:
        positions = self._source.joints(modality)
        if positions is None:
            raise self._absent(modality)
        return Joints(modality, positions, self._source.rate, self.certainty.get(modality))

    def _absent(self, modality: str) -> Absent:
        return refused(f"`{modality}` was not reconstructed", f"there is {_names(self.modalities)}", Absent)

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
        return Gaze(points, self._source.rate, size, self.certainty.get("gaze"))

    @cached_property
    def depth(self) -> Depth:
        """Depth of every frame that the model saw."""
        found = self._source.depth()
        if found is None:
            raise self._absent("depth")
        return Depth(*found, self.manifest)

    @cached_property
    def pictures(self) -> Pictures:
        """The square frames that the model saw, as its page has them."""
        page = self.page()
        about = re.search(r'<script type="application/json" id="manifest">(.*?)</script>', page, re.DOTALL)
        video = json.loads(about[1])["video"] if about else None
        held = re.search(r'<script type="text/plain" id="blob-video">(.*?)</script>', page, re.DOTALL)
        if not video or not held:
            return Pictures((), 1.0)
        blob, ends = base64.b64decode(held[1]), video["offsets"]
        return Pictures(tuple(blob[a:b] for a, b in zip(ends, ends[1:])), float(video["rate"]))

    @cached_property
    def samples(self) -> dict[str, np.ndarray]:
        """Every sample by modality, ``[samples, ...]`` and then as in the reconstruction; empty unless asked for (``samples=8``)."""
        return self._source.samples()

    @cached_property
    def spread(self) -> dict[str, np.ndarray]:
        """How far the samples are from their mean, by modality: ``[T, 1]`` or ``[T, 21]``, metres (gaze: shares of the image)."""
        return self._source.spread()

    @cached_property
    def signals(self) -> dict[str, Signal]:
        """Every other modality, by name."""
        return {name: Signal(name, *parts) for name, parts in self._source.signals().items()}

    @cached_property
    def modalities(self) -> tuple[str, ...]:
        """What was reconstructed."""
        source = self._source
        built_in = [("camera", source.camera()), ("gaze", source.gaze())]
        built_in += [(name, source.joints(name)) for name in ("left_hand", "right_hand", "body")]
        found = [name for name, values in built_in if values is not None]
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

    def to_rerun(self, path: str | os.PathLike[str]) -> Path:
        """Writes an ``.rrd`` for `Rerun <https://rerun.io>`_, which ``rerun FILE`` opens; needs ``pip install rerun-sdk``.

        :mod:`reviv.rerun` says what is in it, and sends the same to a viewer that is open.
        """
        from .rerun import write

        return write(self, path)

    def __repr__(self) -> str:
        lines = [f"<reconstruction of `{self.title}`, {self.seconds:.2f} s: {_names(self.modalities)}"]
        lines += [f"  {label}: {value}" for label, value in self.assumptions.items()]
        if "depth" in self:
            lines.append(f"  Depth: {scale_words(self.manifest['scale'])}")
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
    samples: int = 1,
    progress: Progress = None,
    runs: str | os.PathLike[str] = "runs",
) -> Reconstruction:
    """Reconstructs the wearer and the world of a video; nothing is written.

    ``model`` is a :class:`Model`, a model folder, or a run that trained one; without it, the model of the latest run in ``runs``.
    ``decoding`` names how tokens are generated (``fast``, ``paper``, ...), ``fov`` is the horizontal field of view of the centre
    square in degrees, ``anchor`` metric depth of another model to take the scale from. ``samples`` above one gives as many beside
    the reconstruction, with their spread. ``progress`` is True for a bar, or a callable
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
        samples,
        callback(progress),
    )
    return Reconstruction(made)


def open(folder: str | os.PathLike[str]) -> Reconstruction:  # noqa: A001
    """A reconstruction from the folder that :meth:`Reconstruction.write` or ``reviv reconstruct`` made."""
    return Reconstruction(_Folder(Path(folder)))
