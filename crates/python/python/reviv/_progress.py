"""Who hears how far a long call is."""

from __future__ import annotations

import sys
from typing import Any, Callable, Optional, Union

Callback = Callable[[int, int, str], Optional[bool]]
Progress = Union[None, bool, Callback]


class _Bar:
    """A bar of tqdm where it is installed, else a line on stderr."""

    def __init__(self) -> None:
        self._bar: Any = None
        try:
            from tqdm.auto import tqdm
        except ImportError:
            self._tqdm = None
        else:
            self._tqdm = tqdm

    def __call__(self, done: int, total: int, unit: str) -> None:
        if self._tqdm is None:
            print(f"\r{done}/{total} {unit}", end="\n" if done == total else "", file=sys.stderr, flush=True)
            return
        if self._bar is None:
            self._bar = self._tqdm(total=total, unit=unit.rstrip("s"))
        self._bar.update(done - self._bar.n)
        if done == total:
            self._bar.close()


def callback(progress: Progress) -> Callback | None:
    """``True`` is a bar; a callable hears ``(done, total, unit)`` and stops the work by returning False."""
    if progress is None or progress is False:
        return None
    if progress is True:
        return _Bar()
    if not callable(progress):
        raise TypeError("`progress` is True, or a callable that takes (done, total, unit)")
    return progress
