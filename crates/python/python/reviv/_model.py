"""Models, and tables of their scores."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

import numpy as np

from . import _reviv
from ._error import refused
from ._progress import Progress, callback

if TYPE_CHECKING:
    from ._clips import Clip, Clips


class Model:
    """A transformer with its tokenizers; :func:`load` opens one."""

    def __init__(self, native: _reviv.Model) -> None:
        self._native = native

    @property
    def modalities(self) -> tuple[str, ...]:
        """What it has tokens of."""
        return tuple(self._native.modalities)

    @property
    def takes_pixels(self) -> bool:
        """Whether raw video is an input beside the tokens."""
        return self._native.takes_pixels

    def vocabulary(self, modality: str) -> int:
        """How many different tokens a modality has."""
        found = self._native.vocabulary(modality)
        if found is None:
            raise refused(f"no modality `{modality}` in this model", f"it has: {', '.join(self.modalities)}")
        return found

    def encode(self, clip: Clip) -> dict[str, np.ndarray]:
        """The tokens of a clip by modality: int64, each in the shape of its grid, time first."""
        return self._native.encode(clip._native)

    def __repr__(self) -> str:
        frames, rate, size = self._native.format
        pixels = " and raw video" if self.takes_pixels else ""
        return (
            f"<model `{self._native.place}` on {self._native.device}: tokens of {', '.join(self.modalities)}{pixels}; "
            f"clips of {frames} frames at {rate:g} Hz, {size} x {size}>"
        )


def load(
    model: str | os.PathLike[str] | None = None,
    *,
    device: str = "cpu",
    runs: str | os.PathLike[str] = "runs",
) -> Model:
    """Opens a model folder, or the model that a run trained; without a name, that of the latest run in ``runs``.

    ``device`` is ``cpu``, ``auto``, or a GPU (``cuda``, ``cuda:1``, ``vulkan``, ...) as far as the package was built with it.
    """
    path = None if model is None else os.fspath(model)
    return Model(_reviv.open_model(path, device, os.fspath(runs)))


class Table:
    """Systems against metrics, with 95 % intervals, the trivial baselines and what must be read with the numbers."""

    def __init__(self, native: _reviv.Table) -> None:
        self._native = native
        #: Everything, as JSON has it: ``title``, ``columns``, ``rows`` with their ``cells``, ``notes``.
        self.data: dict[str, Any] = json.loads(native.json())

    @property
    def columns(self) -> tuple[str, ...]:
        """The metrics, by name."""
        return tuple(str(column["name"]) for column in self.data["columns"])

    @property
    def rows(self) -> tuple[str, ...]:
        """The systems."""
        return tuple(str(row["label"]) for row in self.data["rows"])

    @property
    def values(self) -> np.ndarray:
        """``[rows, columns]``; NaN where there is no value."""
        cells = [[cell["value"] for cell in row["cells"]] for row in self.data["rows"]]
        values = np.array([[np.nan if value is None else value for value in row] for row in cells], dtype=np.float64)
        return values.reshape(len(self.rows), len(self.columns))

    def __getitem__(self, key: tuple[str, str]) -> float:
        """The value of a row in a column: ``table["reviv", "body.ga_mpjpe"]``."""
        row, column = key
        for name, known in ((row, self.rows), (column, self.columns)):
            if name not in known:
                raise KeyError(f"`{name}`; there is {', '.join(known)}")
        return float(self.values[self.rows.index(row), self.columns.index(column)])

    def markdown(self) -> str:
        """As Markdown."""
        return self._native.render("md")

    def latex(self) -> str:
        """As LaTeX."""
        return self._native.render("latex")

    def csv(self) -> str:
        """One line per cell, every number in full."""
        return self._native.render("csv")

    def __repr__(self) -> str:
        return self._native.render("term")

    def _repr_html_(self) -> str:
        return self._native.html()


def evaluate(
    model: Model | str | os.PathLike[str] | None,
    clips: Clips | str | os.PathLike[str],
    *,
    split: str = "test",
    inputs: list[str] | None = None,
    targets: list[str] | None = None,
    decoding: str | None = None,
    seed: int = 0,
    name: str = "reviv",
    device: str = "cpu",
    progress: Progress = None,
    runs: str | os.PathLike[str] = "runs",
) -> Table:
    """Scores a model on clips it has not seen, beside the trivial baselines on the same clips.

    ``clips`` is what :func:`clips` or :func:`world` give, or a place that :func:`clips` opens, of which ``split`` is taken.
    ``inputs`` is what the model is given (video, by default), ``targets`` what it predicts (all others).
    """
    from ._clips import Clips, clips as open_clips

    opened = model if isinstance(model, Model) else load(model, device=device, runs=runs)
    source = clips if isinstance(clips, Clips) else open_clips(clips, split, runs=runs)
    return Table(
        _reviv.evaluate(
            opened._native, source._native, inputs, targets or [], decoding, seed, name, callback(progress)
        )
    )


def compare(
    *names: str | os.PathLike[str],
    baseline: str | None = None,
    columns: list[str] | None = None,
    level: float = 0.95,
    runs: str | os.PathLike[str] = "runs",
) -> Table:
    """Runs, arms and seeds in one table with intervals and paired differences; as ``reviv compare``.

    A name is that of a run, its folder, or a file of scores. ``baseline`` is the row that all others are tested against.
    """
    paths = [os.fspath(name) for name in names]
    return Table(_reviv.compare(paths, baseline, columns or [], level, os.fspath(runs)))
