"""Reconstruct the viewer and the view in 4D from one head-mounted video.

>>> import reviv
>>> r = reviv.reconstruct("walk.mp4", model="models/reviv_500b")  # doctest: +SKIP
>>> r.body.positions            # [samples, 21, 3], metres, z up  # doctest: +SKIP
>>> r.write("out/")             # the folder and the page         # doctest: +SKIP
>>> reviv.open("out/")          # the same object, later          # doctest: +SKIP

:func:`clips` and :func:`tokens` feed training loops, :func:`world` makes clips without any data, :func:`evaluate` and
:func:`compare` give tables with intervals. The command line is in the same package: ``reviv --help``.
"""

from ._clips import Batch, Clip, Clips, Tokens, clips, tokens, world
from ._error import Absent
from ._model import Model, Table, compare, evaluate, load
from ._parts import CameraPath, Depth, Gaze, Joints, Pictures, Signal
from ._reconstruction import Reconstruction, open, reconstruct
from ._reviv import Error, Stopped, version as _version

__version__ = _version()

__all__ = [
    "Absent",
    "Batch",
    "CameraPath",
    "Clip",
    "Clips",
    "Depth",
    "Error",
    "Gaze",
    "Joints",
    "Model",
    "Pictures",
    "Reconstruction",
    "Signal",
    "Stopped",
    "Table",
    "Tokens",
    "clips",
    "compare",
    "evaluate",
    "load",
    "open",
    "reconstruct",
    "tokens",
    "world",
]
