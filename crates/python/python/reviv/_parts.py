"""What a reconstruction holds: joints, the camera, gaze, depth, pictures, other signals."""

from __future__ import annotations

import base64
import html
from typing import Any, Mapping

import numpy as np

from . import _reviv
from ._error import Absent, refused

_WORLD = "world: z up, metres, origin and heading of the first camera"
_CAMERA = "camera of the same sample: x right, y down, z forward, metres"
_IMAGE = "upright square image"


class Joints:
    """21 named joints over time: the body in the world, or a hand in the camera of the same sample."""

    def __init__(self, modality: str, positions: np.ndarray, rate: float, certainty: np.ndarray | None) -> None:
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
        self.certainty: np.ndarray | None = certainty

    @property
    def valid(self) -> np.ndarray:
        """``[samples, 21]``: which joints are known."""
        known: np.ndarray = np.isfinite(self.positions).all(axis=-1)
        return known

    def position(self, joint: str, seconds: float) -> np.ndarray:
        """Where a joint is, ``[3]`` metres: linear between the samples around ``seconds``."""
        if joint not in self.names:
            raise refused(f"no joint `{joint}`", ", ".join(self.names))
        length = len(self.positions) / self.rate
        if not 0 <= seconds <= length:
            raise refused(f"{seconds} s lies outside the recording of {length} s", f"0 to {length:g} s")
        track = self.positions[:, self.names.index(joint)]
        at = min(seconds * self.rate, len(track) - 1)
        before = int(at)
        after, share = min(before + 1, len(track) - 1), at - before
        # An unknown neighbour does not matter exactly at a sample.
        between: np.ndarray = track[before] if share == 0 else (1 - share) * track[before] + share * track[after]
        return between.copy()

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

    def __init__(self, points: np.ndarray, rate: float, size: tuple[int, int], certainty: np.ndarray | None) -> None:
        #: ``[samples, 2]``: x right and y down as shares of the upright square image; NaN where unknown.
        self.points: np.ndarray = points
        #: Samples per second.
        self.rate: float = rate
        #: The frame of reference, in words.
        self.frame: str = _IMAGE
        #: Width and height of the square frames that the model saw, pixels.
        self.size: tuple[int, int] = size
        #: ``[samples]``, 0 (a guess) to 1 (certain). Not an accuracy.
        self.certainty: np.ndarray | None = certainty

    @property
    def pixels(self) -> np.ndarray:
        """``[samples, 2]``: in pixels of the square frames; the centre of the top left pixel is (0, 0)."""
        pixels: np.ndarray = self.points * np.array(self.size, dtype=self.points.dtype) - self.points.dtype.type(0.5)
        return pixels

    @property
    def valid(self) -> np.ndarray:
        """``[samples]``: where it is known."""
        known: np.ndarray = np.isfinite(self.points).all(axis=-1)
        return known

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
        self.scale: str = scale_words(manifest["scale"])
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
            raise refused(
                f"depth is relative: {self.refused}",
                "`values` has it up to scale and shift; `anchor=` gives it a scale",
                Absent,
            )
        return self.values

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        frames, height, width = self.values.shape
        return f"<depth: {frames} maps of {height} x {width} at {self.rate:g} Hz, {self.scale}>"


class Pictures:
    """The square frames that the model saw."""

    def __init__(self, jpegs: tuple[bytes, ...], rate: float) -> None:
        #: One JPEG a frame; ``PIL.Image.open(io.BytesIO(jpeg))`` and ``IPython.display.Image(jpeg)`` show one.
        self.jpegs: tuple[bytes, ...] = jpegs
        #: Frames per second.
        self.rate: float = rate

    def __len__(self) -> int:
        return len(self.jpegs)

    def __repr__(self) -> str:
        return f"<{len(self)} pictures at {self.rate:g} Hz>"

    def _repr_html_(self) -> str:
        # A strip of at most eight, from the first to the last.
        shown = min(8, len(self))
        chosen = [round(k * (len(self) - 1) / max(shown - 1, 1)) for k in range(shown)]
        images = [
            f'<img src="data:image/jpeg;base64,{base64.b64encode(self.jpegs[index]).decode()}" '
            f'title="{index / self.rate:.2f} s" style="width: 12%; margin: 0 .25% 0 0">'
            for index in chosen
        ]
        return f"<div>{''.join(images)}</div><div>{html.escape(repr(self))}</div>"


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


def scale_words(status: Any) -> str:
    if isinstance(status, Mapping):
        inner = status.get("metric", status)
        return f"metric by {inner['by']}" if isinstance(inner, Mapping) and "by" in inner else str(status)
    return "no length" if status == "none" else str(status)
