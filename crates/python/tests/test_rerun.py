"""Recordings for Rerun, read back by its SDK."""

import subprocess
import sys

import numpy as np
import pytest
import reviv
import reviv.rerun
from conftest import command, skip_without


def sent(path):
    """By entity and component: times in seconds (none where it holds for all times) and values."""
    (chunks,) = skip_without("rerun.chunk")
    found = {}
    for chunk in chunks.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        names = batch.schema.names
        times = None
        if "seconds" in names:
            times = np.array(batch["seconds"].cast("int64")) / 1e9
        for name in names:
            if ":" not in name or name.startswith("rerun."):
                continue
            rows = batch[name].to_pylist()
            before = found.setdefault(chunk.entity_path.lstrip("/"), {}).setdefault(name, ([], []))
            before[0].extend([] if times is None else times)
            before[1].extend(rows)
    return found


@pytest.fixture
def recording(made, tmp_path):
    skip_without("rerun", "rerun.chunk")
    return sent(made.to_rerun(tmp_path / "walk.rrd"))


def test_camera_body_and_hand_are_where_the_arrays_have_them(made, recording):
    times = np.arange(105) / 30
    at, places = recording["world/camera"]["Transform3D:translation"]
    assert np.allclose(at, times, atol=1e-8)
    assert np.allclose(np.array(places)[:, 0], made.camera.positions, atol=1e-5)
    # The SDK keeps matrices column by column.
    turns = np.array(recording["world/camera"]["Transform3D:mat3x3"][1]).reshape(-1, 3, 3)
    assert np.allclose(turns.transpose(0, 2, 1), made.camera.T_world_camera[:, :3, :3], atol=1e-5)
    for entity, joints in (("world/body", made.body), ("world/camera/left_hand", made.left_hand)):
        at, rows = recording[entity]["Points3D:positions"]
        assert np.allclose(at, times, atol=1e-8)
        numbers = recording[entity]["Points3D:keypoint_ids"][1]
        for truth, known, points, ids in zip(joints.positions, joints.valid, rows, numbers):
            assert ids == np.flatnonzero(known).tolist()
            assert np.allclose(np.array(points).reshape(-1, 3), truth[known], atol=1e-6)
        (context,) = recording[entity]["AnnotationContext:context"][1]
        text = str(context)
        assert all(repr(name) in text for name in joints.names), "bones without names"


def test_gaze_and_pictures_lie_in_the_pinhole(made, recording):
    image = recording["world/camera/image"]
    matrix = np.array(image["Pinhole:image_from_camera"][1]).reshape(3, 3).T
    assert np.allclose(matrix[:2, 2], 32) and matrix[0, 0] == pytest.approx(32)
    at, rows = recording["world/camera/image/gaze"]["Points2D:positions"]
    assert len(at) == 105
    shown = np.array([row[0] if row else [np.nan, np.nan] for row in rows])
    assert np.allclose(shown / 64, made.gaze.points, atol=1e-5, equal_nan=True)
    at, blobs = image["EncodedImage:blob"]
    assert np.allclose(at, np.arange(28) / 8)
    assert [bytes(blob[0]) for blob in blobs] == list(made.pictures.jpegs)
    assert all(jpeg[:2] == b"\xff\xd8" and jpeg[-2:] == b"\xff\xd9" for jpeg in made.pictures.jpegs)


def test_certainty_and_assumptions_are_there(made, recording):
    at, rows = recording["certainty/body"]["Scalars:scalars"]
    assert np.allclose(np.array(rows)[:, 0], made.body.certainty, atol=1e-6, equal_nan=True)
    (text,) = recording["about"]["TextDocument:text"][1]
    assert "ASSUMED: 90 degrees" in text[0]


def test_metric_depth_stands_in_the_world_and_relative_depth_beside_it(deep, tmp_path):
    skip_without("rerun", "rerun.chunk")
    relative, metric = deep
    found = sent(metric.to_rerun(tmp_path / "metric.rrd"))
    at, rows = found["world/camera/image/depth"]["DepthImage:buffer"]
    assert np.allclose(at, np.arange(16) / 8)
    values = np.frombuffer(bytes(rows[3][0]), dtype="<u2").reshape(64, 64) / 1000
    assert np.allclose(values, np.clip(metric.depth.metres[3], 0, 65.535), atol=5.1e-4)
    assert "depth" not in found
    found = sent(relative.to_rerun(tmp_path / "relative.rrd"))
    assert "world/camera/image/depth" not in found
    values = np.frombuffer(bytes(found["depth"]["DepthImage:buffer"][1][3][0]), dtype="<f4").reshape(64, 64)
    assert np.array_equal(values, relative.depth.values[3])


def test_the_command_writes_the_same_from_a_video_and_from_a_folder(place, video, tmp_path):
    skip_without("rerun", "rerun.chunk")
    out = tmp_path / "out"
    for _ in range(2):
        # Asked again, the recording is no foreign file.
        said = command("reconstruct", video, "-o", out, "--export", "rerun", folder=place)
        assert str(out / "scene.rrd") in said.stderr
    first = sent(out / "scene.rrd")
    asked = [sys.executable, "-m", "reviv.rerun", str(out), "-o", str(tmp_path / "again.rrd")]
    said = subprocess.run(asked, capture_output=True, text=True, check=True)
    assert said.stdout.strip() == str(tmp_path / "again.rrd")
    again = sent(tmp_path / "again.rrd")
    first.pop("__properties"), again.pop("__properties")
    assert first.keys() == again.keys()
    assert first["world/body"] == again["world/body"]


def test_without_the_sdk_it_is_said_before_anything_is_computed(place, video, tmp_path):
    (tmp_path / "rerun.py").write_text("raise ImportError('not here')\n")
    import os

    hidden = {**os.environ, "PYTHONPATH": str(tmp_path)}
    asked = [sys.executable, "-m", "reviv", "reconstruct", str(video), "-o", "none", "--export", "rerun"]
    said = subprocess.run(asked, cwd=place, env=hidden, capture_output=True, text=True, check=False)
    assert said.returncode == 1
    assert "the Rerun SDK is not installed in this Python: not here" in said.stderr
    assert "pip install . rerun-sdk" in said.stderr
    assert not (place / "none").exists()


def test_a_place_that_cannot_be_written_is_said(made, tmp_path):
    skip_without("rerun")
    with pytest.raises(reviv.Error, match="nowhere.*\nhint: name a file in a folder that is there"):
        made.to_rerun(tmp_path / "nowhere" / "walk.rrd")
    with pytest.raises(reviv.Error, match="no reconstruction"):
        reviv.open(tmp_path)
