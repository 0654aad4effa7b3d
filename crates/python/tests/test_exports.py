"""What the folder holds for other programs, read by readers that others wrote."""

import json

import numpy as np
import pytest
import reviv
from conftest import command, skip_without


def y_up(points):
    """Our world (z up) as glTF has it (y up)."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def quaternion(q):
    """Rotation matrices of `[..., xyzw]`."""
    x, y, z, w = np.moveaxis(np.asarray(q, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def accessor(gltf, index):
    """The numbers of an accessor of floats."""
    about = gltf.accessors[index]
    view = gltf.bufferViews[about.bufferView]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[about.type]
    blob = gltf.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(blob, dtype="<f4").reshape(about.count, width)


def animated(gltf):
    """Node index to its world matrices over time."""
    tracks = {}
    for channel in gltf.animations[0].channels:
        sampler = gltf.animations[0].samplers[channel.sampler]
        tracks[channel.target.node, channel.target.path] = accessor(gltf, sampler.output)
    frames = max(len(track) for track in tracks.values())
    world = {}

    def place(node, above):
        local = np.tile(np.eye(4), (frames, 1, 1))
        rest = gltf.nodes[node].translation
        local[:, :3, 3] = tracks.get((node, "translation"), [rest] if rest else [[0, 0, 0]])
        if (node, "rotation") in tracks:
            local[:, :3, :3] = quaternion(tracks[node, "rotation"])
        world[node] = above @ local
        for child in gltf.nodes[node].children or []:
            place(child, world[node])

    for root in gltf.scenes[0].nodes:
        place(root, np.eye(4))
    return world


def test_gltf_has_every_joint_and_the_camera_where_the_arrays_have_them(made, folder):
    (pygltflib,) = skip_without("pygltflib")
    gltf = pygltflib.GLTF2().load(str(folder / "scene.glb"))
    world = animated(gltf)
    nodes = {node.name: index for index, node in enumerate(gltf.nodes)}
    whole = made.body.valid.all(axis=1)
    assert whole.all()
    for joint, name in enumerate(made.body.names):
        truth = y_up(made.body.positions[:, joint])
        assert np.allclose(world[nodes[f"body_{name}"]][:, :3, 3], truth, atol=1e-4), name
    camera = world[nodes["camera"]]
    assert np.allclose(camera[:, :3, 3], y_up(made.camera.positions), atol=1e-4)
    # glTF's camera looks along -z, ours along z.
    assert np.allclose(-camera[:, :3, 2], y_up(made.camera.T_world_camera[:, :3, 2]), atol=1e-4)
    lens = gltf.cameras[0].perspective
    assert lens.yfov == pytest.approx(np.pi / 2) and lens.aspectRatio == 1
    times = accessor(gltf, gltf.animations[0].samplers[0].input)[:, 0]
    assert np.allclose(np.diff(times), 1 / 30, atol=1e-5)


def test_gltf_opens_as_a_scene_with_bones(folder):
    (trimesh,) = skip_without("trimesh")
    scene = trimesh.load(folder / "scene.glb")
    names = set(scene.geometry)
    assert any("body" in name for name in names), names
    for mesh in scene.geometry.values():
        # Twenty bones of eight sides.
        assert len(mesh.faces) == 160 and np.isfinite(mesh.vertices).all()


def test_nerfstudio_has_pictures_and_cameras_that_see_what_ours_see(place, video, tmp_path):
    out = tmp_path / "out"
    command("reconstruct", video, "-o", out, "--export", "nerfstudio", folder=place)
    data = json.loads((out / "nerfstudio/transforms.json").read_text())
    r = reviv.open(out)
    assert len(data["frames"]) == 28  # eight a second over 3.5 s
    for index, frame in enumerate(data["frames"]):
        picture = (out / "nerfstudio" / frame["file_path"]).read_bytes()
        assert picture[:2] == b"\xff\xd8"
        pose = np.array(frame["transform_matrix"])
        ours = r.camera.T_world_camera[min(round(index / 8 * 30), 104)]
        assert np.allclose(pose @ np.diag([1, -1, -1, 1]), ours, atol=1e-9)
    scale = data["w"] / r.camera.size[0]
    assert data["fl_x"] == pytest.approx(r.camera.K[0, 0] * scale)
    assert data["cx"] == pytest.approx((r.camera.K[0, 2] + 0.5) * scale)
    # Asked again, the data set is no foreign file.
    command("reconstruct", video, "-o", out, folder=place)


def test_without_depth_there_is_no_cloud_and_the_manifest_names_none(folder):
    manifest = json.loads((folder / "manifest.json").read_text())
    assert "points.ply" not in manifest["files"] and not (folder / "points.ply").exists()


def test_every_array_that_the_manifest_names_is_there_with_its_shape(folder):
    manifest = json.loads((folder / "manifest.json").read_text())
    for entry in manifest["arrays"]:
        with np.load(folder / entry["file"]) as arrays:
            assert list(arrays[entry["name"]].shape) == entry["shape"], entry
    assert all((folder / name).is_file() for name in manifest["files"])


def test_the_overlay_is_a_movie_of_every_sample(place, video, tmp_path):
    import shutil
    import subprocess

    out = tmp_path / "out"
    command("reconstruct", video, "-o", out, "--video", folder=place)
    if shutil.which("ffprobe") is None:
        assert (out / "overlay.avi").read_bytes()[8:12] == b"AVI "
        pytest.skip("no ffprobe on the PATH: the movie is not opened")
    asked = ["ffprobe", "-v", "error", "-count_frames", "-select_streams", "v", "-of", "csv=p=0"]
    asked += ["-show_entries", "stream=codec_name,width,height,avg_frame_rate,nb_read_frames", str(out / "overlay.mp4")]
    said = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    assert said == "h264,512,512,30/1,105"
