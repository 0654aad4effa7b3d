"""`reviv.reconstruct` and `reviv.open`: arrays, errors, callbacks, and the same object from memory and from a folder."""

import gc
import json
import threading
import time

import numpy as np
import pytest
import reviv


def test_arrays_have_the_shapes_units_and_names_that_are_promised(made):
    assert made.seconds == pytest.approx(3.5)
    assert made.modalities == ("camera", "gaze", "left_hand", "body")
    assert made.body.positions.shape == (105, 21, 3)
    assert made.body.positions.dtype == np.float32
    assert made.body.names[0] == "pelvis" and made.body.parents[0] == 0
    assert made.left_hand.names[0] == "wrist"
    assert made.camera.T_world_camera.shape == (105, 4, 4)
    # Rotations are rotations, and the world starts at the first camera.
    turns = made.camera.T_world_camera[:, :3, :3]
    assert np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    assert np.allclose(made.camera.positions[0], 0, atol=1e-9)
    assert made.gaze.pixels.shape == (105, 2)
    known = made.gaze.valid
    assert np.allclose((made.gaze.pixels[known] + 0.5) / 64, made.gaze.points[known], atol=1e-6)
    assert set(made.certainty) == {"camera", "gaze", "left_hand", "body"}
    assert made.body.certainty.shape == (105,)
    assert made.camera.K[0, 0] == pytest.approx(32)  # 90 degrees over 64 pixels
    assert made.body.rate == made.camera.rate == 30


def test_a_joint_is_found_by_name_and_between_samples(made):
    body = made.body
    wrist = body.names.index("left_wrist")
    between = (body.positions[30, wrist] + body.positions[31, wrist]) / 2
    assert np.allclose(body.position("left_wrist", 30.5 / 30), between, atol=1e-6)
    with pytest.raises(reviv.Error, match="no joint `tail`"):
        body.position("tail", 1)
    with pytest.raises(reviv.Error, match="outside the recording"):
        body.position("head", 4)


def test_views_are_read_only_and_outlive_the_object_they_look_into(video, model):
    made = reviv.reconstruct(video, model, seconds=2)
    positions = made.body.positions
    with pytest.raises(ValueError):
        positions[0, 0, 0] = 1
    assert positions.base is not None, "a view, not a copy"
    before = positions.copy()
    del made
    gc.collect()
    junk = [np.ones(positions.shape, dtype=np.float32) for _ in range(64)]
    assert np.array_equal(positions, before, equal_nan=True) and len(junk) == 64


def test_a_folder_gives_the_same_object_as_the_memory_it_was_written_from(made, folder):
    again = reviv.open(folder)
    assert again.modalities == made.modalities
    same = {"equal_nan": True}
    assert np.array_equal(again.body.positions, made.body.positions, **same)
    assert np.array_equal(again.left_hand.positions, made.left_hand.positions, **same)
    assert np.array_equal(again.camera.T_world_camera, made.camera.T_world_camera)
    assert np.array_equal(again.gaze.points, made.gaze.points, **same)
    for name, values in made.certainty.items():
        assert np.array_equal(again.certainty[name], values, **same)
    assert again.assumptions == made.assumptions
    assert again.page() == made.page()
    assert repr(again) == repr(made)


def test_a_reconstruction_says_what_it_is_and_shows_its_page(made):
    text = repr(made)
    assert "reconstruction of `walk`, 3.50 s" in text and "ASSUMED: 90 degrees" in text
    assert "left_hand: 105 samples of 21 joints at 30 Hz" in repr(made.left_hand)
    page = made._repr_html_()
    assert page.startswith("<iframe srcdoc=") and "&lt;!doctype html&gt;" in page.lower()


def test_what_is_absent_is_said_and_hasattr_works(made):
    with pytest.raises(reviv.Absent, match="`depth` was not reconstructed\nhint: there is camera, gaze"):
        made.depth
    assert not hasattr(made, "right_hand")
    assert "body" in made and "depth" not in made


def test_the_same_seed_gives_the_same_arrays(video, model, made):
    again = reviv.reconstruct(video, model)
    assert np.array_equal(again.body.positions, made.body.positions, equal_nan=True)
    other = reviv.reconstruct(video, model, seed=1)
    assert json.dumps(other.manifest) != json.dumps(made.manifest)


def test_a_callback_hears_every_window_and_can_stop_it(video, model):
    heard = []
    reviv.reconstruct(video, model, progress=lambda *at: heard.append(at))
    assert heard[-1] == (3, 3, "windows")
    assert [done for done, _, _ in heard] == sorted(done for done, _, _ in heard)
    with pytest.raises(reviv.Stopped):
        reviv.reconstruct(video, model, progress=lambda *_: False)

    def fails(*_):
        raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        reviv.reconstruct(video, model, progress=fails)
    with pytest.raises(TypeError, match="done, total, unit"):
        reviv.reconstruct(video, model, progress=3)


def test_a_bar_reaches_its_end(video, model, capsys):
    reviv.reconstruct(video, model, seconds=2, progress=True)
    assert "1/1" in capsys.readouterr().err


def test_other_threads_of_python_go_on_while_it_computes(video, model):
    ticks, done = [], threading.Event()

    def tick():
        while not done.is_set():
            ticks.append(time.perf_counter())
            time.sleep(0.001)

    thread = threading.Thread(target=tick)
    thread.start()
    start = time.perf_counter()
    reviv.reconstruct(video, model, seconds=2)
    end = time.perf_counter()
    done.set()
    thread.join()
    during = [at for at in ticks if start < at < end]
    # With the lock held there would be a single gap as long as the call.
    gaps = np.diff([start, *during, end])
    assert gaps.max() < 0.5 * (end - start), f"{gaps.max():.3f} s of {end - start:.3f} s"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"video": "nowhere.mp4"}, "nowhere.mp4"),
        ({"model": "nowhere"}, "no run `nowhere`"),
        ({"start": 99}, "nothing is left from 99.00 s on"),
        ({"overlap": 5}, "overlap"),
        ({"decoding": "quick"}, "no decoding `quick`\nhint: `reviv list decoding`"),
        ({"targets": ["smell"]}, "the model has no modality `smell`; it has"),
        ({"fov": 500}, "field"),
        ({"device": "tpu", "model": None}, "`tpu`"),
    ],
)
def test_errors_have_the_words_of_the_command_line(video, model, runs, change, words):
    arguments = {"video": video, "model": model, "runs": runs, **change}
    with pytest.raises(reviv.Error) as caught:
        reviv.reconstruct(**arguments)
    assert words in str(caught.value)


def test_a_folder_that_is_none_is_refused_with_a_way_out(tmp_path):
    with pytest.raises(reviv.Error, match="no reconstruction.*\nhint: give the folder"):
        reviv.open(tmp_path)


def test_samples_are_the_same_from_memory_and_from_a_folder_and_leave_the_reconstruction_alone(video, model, tmp_path):
    made = reviv.reconstruct(video, model, seconds=2, samples=3)
    assert made.samples["body"].shape == (3, 60, 21, 3) and made.spread["body"].shape == (60, 21)
    assert made.samples["camera"].shape == (3, 60, 4, 4) and made.samples["gaze"].shape == (3, 60, 2)
    middle = made.samples["body"].astype(np.float64).mean(axis=0)
    around = np.linalg.norm(made.samples["body"] - middle, axis=-1)
    assert np.allclose(made.spread["body"], np.sqrt((around**2).mean(axis=0)), atol=1e-4)
    made.write(tmp_path / "out")
    again = reviv.open(tmp_path / "out")
    assert again.camera.T_world_camera.shape == (60, 4, 4)
    assert np.array_equal(again.body.positions, made.body.positions, equal_nan=True)
    assert again.modalities == made.modalities and not again.signals
    for kept, fresh in ((again.samples, made.samples), (again.spread, made.spread)):
        assert kept.keys() == fresh.keys()
        assert all(np.array_equal(kept[name], fresh[name], equal_nan=True) for name in kept)
    assert not reviv.reconstruct(video, model, seconds=2).samples


def test_pictures_are_those_of_the_page(made, folder):
    assert len(made.pictures) == 28 and made.pictures.rate == 8 and "28 pictures at 8 Hz" in repr(made.pictures)
    assert made.pictures.jpegs == reviv.open(folder).pictures.jpegs
    strip = made.pictures._repr_html_()
    assert strip.count("<img") == 8 and 'title="0.00 s"' in strip and 'title="3.38 s"' in strip


def test_every_error_has_a_way_out_or_says_that_it_has_none(made, model, tmp_path):
    with pytest.raises(reviv.Absent) as absent:
        made.depth
    assert absent.value.help == "there is camera, gaze, left_hand, body"
    with pytest.raises(reviv.Error) as error:
        reviv.open(tmp_path)
    assert error.value.help.startswith("give the folder")
    with pytest.raises(reviv.Error) as error:
        model.vocabulary("smell")
    assert error.value.help.startswith("it has: ")
    assert reviv.Stopped("").help == ""
