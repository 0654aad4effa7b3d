"""Clips and tokens as NumPy, to feed a training loop."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Iterator, Mapping, Sequence, overload

import numpy as np

from . import _reviv
from ._error import refused


class Clip(Mapping[str, np.ndarray]):
    """Two seconds of one wearer: a mapping from modality to its values.

    ``clip["rgb"]`` is ``[frames, height, width, 3]`` uint8, ``depth`` ``[frames, height, width]`` metres, ``camera``
    ``[60, 4, 4]`` camera to world, ``gaze`` ``[60, 2]`` in the image, ``left_hand``, ``right_hand`` and ``body`` ``[60, 21, 3]``
    metres; unknown values are not to be used, :meth:`valid` says which are known.
    """

    def __init__(self, native: _reviv.Clip) -> None:
        self._native = native
        self._held: dict[str, dict[str, Any]] = {}

    @property
    def id(self) -> str:
        """Unique and stable: ``source/recording/000012``."""
        return self._native.id

    @property
    def source(self) -> str:
        """The data set it belongs to."""
        return self._native.source

    def arrays(self, modality: str) -> dict[str, Any]:
        """All of a modality: ``values``, where known ``valid`` and ``rate``, and whatever else it has."""
        if modality not in self._held:
            found = self._native.arrays(modality)
            if found is None:
                raise KeyError(f"`{modality}`; clip `{self.id}` has {', '.join(self)}")
            self._held[modality] = found
        return self._held[modality]

    def __getitem__(self, modality: str) -> np.ndarray:
        values: np.ndarray = self.arrays(modality)["values"]
        return values

    def valid(self, modality: str) -> np.ndarray | None:
        """Which values are known; None for all."""
        return self.arrays(modality).get("valid")

    def rate(self, modality: str) -> float | None:
        """Samples per second."""
        return self.arrays(modality).get("rate")

    def __iter__(self) -> Iterator[str]:
        return iter(self._native.modalities)

    def __len__(self) -> int:
        return len(self._native.modalities)

    def __contains__(self, modality: object) -> bool:
        return modality in self._native.modalities

    def __repr__(self) -> str:
        return f"<clip `{self.id}`: {', '.join(self)}>"


class Clips(Sequence[Clip]):
    """Clips by number, made or read when they are asked for."""

    def __init__(self, native: _reviv.Clips, modalities: list[str] | None) -> None:
        self._native = native
        self._modalities = modalities

    @property
    def modalities(self) -> tuple[str, ...]:
        """What its clips can have."""
        return tuple(self._modalities or self._native.modalities)

    def __len__(self) -> int:
        return len(self._native)

    @overload
    def __getitem__(self, index: int) -> Clip: ...
    @overload
    def __getitem__(self, index: slice) -> list[Clip]: ...
    def __getitem__(self, index: int | slice) -> Clip | list[Clip]:
        if isinstance(index, slice):
            return [self[at] for at in range(*index.indices(len(self)))]
        at = index + len(self) if index < 0 else index
        if not 0 <= at < len(self):
            raise IndexError(f"clip {index} of {len(self)}")
        made = self._native.clip(at, self._modalities)
        if made is None:
            raise refused(f"the recording does not allow clip {index}", "iteration leaves such clips out")
        return Clip(made)

    def __iter__(self) -> Iterator[Clip]:
        for index in range(len(self)):
            made = self._native.clip(index, self._modalities)
            if made is not None:
                yield Clip(made)

    def __repr__(self) -> str:
        return f"<{len(self)} clips of `{self._native.place}`: {', '.join(self.modalities)}>"


def clips(
    source: str | os.PathLike[str],
    split: str = "train",
    *,
    modalities: list[str] | None = None,
    runs: str | os.PathLike[str] = "runs",
) -> Clips:
    """Clips of a run, of an artifact, or of a folder that ``reviv data convert`` made.

    ``source`` is a run by its name or path, or a folder with ``<modality>/<data set>/shard-000000.tar``; where it is divided into
    splits, ``split`` is taken. With ``modalities``, nothing else is read.
    """
    return Clips(_reviv.open_clips(os.fspath(source), split, os.fspath(runs)), modalities)


def world(
    count: int,
    *,
    first: int = 0,
    seed: int = 0,
    size: int = 64,
    rooms: int | None = 48,
    modalities: list[str] | None = None,
) -> Clips:
    """Clips of the built-in synthetic world: exact truth of every modality, no licence, made when asked for.

    A clip is a function of ``seed`` and its number alone. ``size`` is the side of the images in pixels, ``rooms`` how many different
    rooms there are (None: a new one for every clip).
    """
    return Clips(_reviv.world(first, count, seed, size, rooms), modalities)


@dataclass(frozen=True)
class Batch(Mapping[str, np.ndarray]):
    """Tokens of several clips."""

    #: The clips' names.
    ids: tuple[str, ...]
    #: By modality ``[clips, *grid]``; 0 where a clip does not have it.
    arrays: dict[str, np.ndarray]
    #: By modality ``[clips]``: which clips have it.
    present: dict[str, np.ndarray]

    def __getitem__(self, modality: str) -> np.ndarray:
        return self.arrays[modality]

    def __iter__(self) -> Iterator[str]:
        return iter(self.arrays)

    def __len__(self) -> int:
        return len(self.arrays)

    def __repr__(self) -> str:
        shapes = ", ".join(f"{name} {list(array.shape)}" for name, array in self.arrays.items())
        return f"<tokens of {len(self.ids)} clips: {shapes}>"


class Tokens:
    """Tokens of clips: iterate over them clip by clip, or over :meth:`batches`."""

    def __init__(self, native: _reviv.Tokens, modalities: list[str] | None) -> None:
        self._native = native
        known = native.modalities
        for name in modalities or []:
            if name not in known:
                raise refused(f"no tokens of `{name}` in `{native.place}`", f"there is {', '.join(known)}")
        self.modalities: tuple[str, ...] = tuple(modalities or known)

    def __len__(self) -> int:
        return len(self._native)

    def id(self, index: int) -> str:
        """The name of a clip."""
        found = self._native.id(index)
        if found is None:
            raise IndexError(f"clip {index} of {len(self)}")
        return found

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        """By modality the tokens of a clip, in the shape of their grid; a modality that it does not have is absent."""
        at = index + len(self) if index < 0 else index
        if not 0 <= at < len(self):
            raise IndexError(f"clip {index} of {len(self)}")
        read = {name: self._native.read(at, name) for name in self.modalities}
        return {name: array for name, array in read.items() if array is not None}

    def __iter__(self) -> Iterator[dict[str, np.ndarray]]:
        return (self[index] for index in range(len(self)))

    def batches(self, size: int, *, seed: int | None = None, drop_last: bool = False) -> Iterator[Batch]:
        """Once through all clips, ``size`` at a time; shuffled where ``seed`` is given."""
        order = np.arange(len(self))
        if seed is not None:
            np.random.default_rng(seed).shuffle(order)
        for start in range(0, len(order), size):
            chosen = order[start : start + size]
            if drop_last and len(chosen) < size:
                return
            yield self._batch(chosen.tolist())

    def _batch(self, chosen: list[int]) -> Batch:
        read = [self[index] for index in chosen]
        arrays, present = {}, {}
        for name in self.modalities:
            has = np.array([name in one for one in read])
            if not has.any():
                continue
            like = next(one[name] for one in read if name in one)
            zeros = np.zeros_like(like)
            arrays[name] = np.stack([one.get(name, zeros) for one in read])
            present[name] = has
        return Batch(tuple(self.id(index) for index in chosen), arrays, present)

    def __repr__(self) -> str:
        return f"<tokens of {len(self)} clips of `{self._native.place}`: {', '.join(self.modalities)}>"


def tokens(
    source: str | os.PathLike[str],
    split: str = "train",
    *,
    modalities: list[str] | None = None,
    runs: str | os.PathLike[str] = "runs",
) -> Tokens:
    """Tokens that ``op: tokenize`` wrote: of a run by its name or path, of an artifact, or of a folder of token shards.

    ``pixels`` is raw video beside the tokens, where the experiment asked for it.
    """
    return Tokens(_reviv.open_tokens(os.fspath(source), split, os.fspath(runs)), modalities)
