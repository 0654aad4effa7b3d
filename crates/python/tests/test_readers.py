"""Each export beside the arrays, read by what others wrote: COLMAP, TUM, BVH, PLY, csv and npz."""

import csv

import numpy as np
import pytest
from conftest import skip_without


def frames_of(made, rate=8.0):
    """The samples of a reconstruction at the frames of the model's video."""
    count = int(np.ceil(made.seconds * rate))
    return [min(round(frame / rate * made.rate), len(made.camera) - 1) for frame in range(count)]


def test_colmap_has_the_cameras_world_to_camera(made, folder):
    (pycolmap,) = skip_without("pycolmap")
    model = pycolmap.Reconstruction(folder / "colmap")
    (camera,) = model.cameras.values()
    K = made.camera.K
    # COLMAP counts pixels from the corner.
    assert np.allclose(camera.params, [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5])
    assert (camera.width, camera.height) == made.camera.size
    chosen = frames_of(made)
    assert len(model.images) == len(chosen)
    images = sorted(model.images.values(), key=lambda image: image.name)
    assert [image.name for image in images] == [f"{index:06}.jpg" for index in range(len(chosen))]
    for image, sample in zip(images, chosen):
        truth = made.camera.T_world_camera[sample]
        found = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        assert np.allclose(found.inverse().matrix(), truth[:3], atol=1e-7)
        # A point a metre ahead is seen in the middle.
        ahead = truth[:3, :3] @ [0, 0, 1] + truth[:3, 3]
        assert np.allclose(image.project_point(ahead), [K[0, 2] + 0.5, K[1, 2] + 0.5], atol=1e-4)


def test_tum_is_a_valid_trajectory_of_the_same_poses(made, folder):
    skip_without("evo")
    from evo.tools import file_interface

    path = file_interface.read_tum_trajectory_file(str(folder / "camera.tum"))
    valid, details = path.check()
    assert valid, details
    assert np.allclose(path.timestamps, np.arange(len(made.camera)) / made.rate, atol=1e-6)
    assert np.allclose(np.array(path.poses_se3), made.camera.T_world_camera, atol=1e-7)


@pytest.mark.parametrize("name", ["body", "left_hand"])
def test_bvh_has_the_root_the_bones_and_their_directions(made, folder, name):
    """BVH has constant bones: lengths are medians, and a joint with one child points to where the child was."""
    (bvhio,) = skip_without("bvhio")
    joints = getattr(made, name)
    assert joints.valid.all()
    # Centimetres, y up: the world turns about x by a quarter, the camera by a half.
    x, y, z = np.moveaxis(joints.positions, -1, 0)
    truth = 100 * np.stack([x, z, -y] if name == "body" else [x, -y, -z], axis=-1)
    # As the file has it: no change of scale, names in the order of the file.
    root = bvhio.readAsHierarchy(str(folder / f"{name}.bvh"))
    found = {joint.Name: joint for joint, _, _ in root.layout()}
    assert root.Name == joints.names[0]
    children = {parent: [i for i, p in enumerate(joints.parents) if p == parent and i != p] for parent in range(21)}
    inner = [i for i in range(21) if children[i]]
    assert set(found) >= {joints.names[i].replace(" ", "_") for i in inner}
    for sample in (0, 52, 104):
        root.loadPose(sample)
        place = {i: np.array(found[joints.names[i].replace(" ", "_")].PositionWorld) for i in inner}
        assert np.allclose(place[0], truth[sample, 0], atol=1e-2)
        for child in inner:
            parent = joints.parents[child]
            if child == parent:
                continue
            bones = np.linalg.norm(truth[:, child] - truth[:, parent], axis=-1)
            bone = place[child] - place[parent]
            # The upper of the two in the middle, where their number is even.
            assert np.linalg.norm(bone) == pytest.approx(np.sort(bones)[len(bones) // 2], abs=2e-2)
            if len(children[parent]) == 1:
                seen = truth[sample, child] - truth[sample, parent]
                assert np.allclose(bone / np.linalg.norm(bone), seen / np.linalg.norm(seen), atol=2e-3)


def in_first_camera(made, points):
    """Points of the world in the camera at the start, and the pixels they are seen in."""
    pose = made.camera.T_world_camera[0]
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    seen = local @ made.camera.K.T
    return local, seen[:, :2] / seen[:, 2:]


@pytest.mark.parametrize("metric", [False, True])
def test_points_are_the_depth_of_the_first_frame_in_its_colours(deep, tmp_path, metric):
    (plyfile,) = skip_without("plyfile")
    made = deep[metric]
    made.write(tmp_path / "out")
    data = plyfile.PlyData.read(tmp_path / "out" / "points.ply")
    assert any(("metric" if metric else "relative") in line for line in data.comments), data.comments
    vertex = data["vertex"]
    # The first frame's points come first, row by row, on a grid as large as the frame.
    first = made.depth.values[0].size
    points = np.stack([vertex[axis][:first] for axis in "xyz"], axis=-1).astype(np.float64)
    local, pixels = in_first_camera(made, points)
    rows, columns = np.indices(made.depth.values[0].shape)
    assert np.allclose(pixels, np.stack([columns, rows], axis=-1).reshape(-1, 2), atol=2e-2)
    assert np.allclose(local[:, 2], made.depth.values[0].reshape(-1), rtol=1e-4)
    colours = np.stack([vertex[name] for name in ("red", "green", "blue")], axis=-1)
    assert colours.dtype == np.uint8 and colours.std() > 0


def test_points_open_as_a_cloud_of_metres(deep, tmp_path):
    (trimesh,) = skip_without("trimesh")
    deep[1].write(tmp_path / "out")
    cloud = trimesh.load(tmp_path / "out" / "points.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    assert len(cloud.vertices) == deep[1].depth.values.size == len(cloud.colors)
    assert np.isfinite(cloud.vertices).all()


def test_gaze_as_a_table_is_the_array(made, folder):
    with (folder / "gaze.csv").open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert [float(row["seconds"]) for row in rows] == pytest.approx(list(np.arange(len(made.gaze)) / 30), abs=1e-6)
    for row, point, known in zip(rows, made.gaze.points, made.gaze.valid):
        assert row["valid"] == str(int(known))
        if known:
            assert [float(row["x"]), float(row["y"])] == pytest.approx(point.tolist(), abs=1e-6)


def test_depth_is_an_array_that_says_whether_it_is_metres(deep, tmp_path):
    relative, metric = deep
    assert np.allclose(metric.depth.metres, 2 * relative.depth.values + 1, rtol=1e-3)
    for made, name in ((relative, "relative"), (metric, "metres")):
        made.write(tmp_path / name)
        with np.load(tmp_path / name / "depth.npz") as arrays:
            assert arrays.files == [name]
            assert np.array_equal(arrays[name], made.depth.values)
