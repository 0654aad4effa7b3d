"""Clips, tokens and the world as NumPy."""

import numpy as np
import pytest
import reviv


def test_the_world_is_a_sequence_of_clips_with_exact_truth():
    world = reviv.world(3, first=5, size=32)
    assert len(world) == 3 and "world" in repr(world)
    clip = world[0]
    assert clip.id == "world/000005"
    assert clip["rgb"].shape == (16, 32, 32, 3) and clip["rgb"].dtype == np.uint8
    assert clip["depth"].shape == (16, 32, 32)
    assert clip["body"].shape == (60, 21, 3) and clip.valid("body").shape == (60, 21)
    assert clip["camera"].shape == (60, 4, 4) and clip.rate("camera") == 30
    assert {"intrinsics", "up_world"} <= set(clip.arrays("camera"))
    assert np.array_equal(world[-3]["rgb"], clip["rgb"])
    assert [one.id for one in world] == [one.id for one in world[0:3]]
    with pytest.raises(IndexError):
        world[3]
    with pytest.raises(KeyError, match="smell"):
        clip["smell"]


def test_the_world_is_a_function_of_its_seed():
    one, two = reviv.world(1)[0]["rgb"], reviv.world(1)[0]["rgb"]
    assert np.array_equal(one, two)
    assert not np.array_equal(one, reviv.world(1, seed=1)[0]["rgb"])
    with pytest.raises(reviv.Error, match="`size`: 4 is not in"):
        reviv.world(1, size=4)


def test_only_the_modalities_that_are_asked_for_are_there(runs):
    clips = reviv.clips("tiny", "test", modalities=["gaze"], runs=runs)
    assert [list(clip) for clip in clips] == [["gaze"]] * 3


def test_clips_of_a_run_are_those_of_the_world_it_took(runs):
    clips = reviv.clips("tiny", runs=runs)
    assert len(clips) == 6 and "rgb" in clips.modalities
    number = int(clips[0].id.split("/")[1])
    truth = reviv.world(1, first=number)[0]
    for modality in ("rgb", "body", "gaze"):
        assert np.array_equal(clips[0][modality], truth[modality], equal_nan=modality != "rgb")


def test_tokens_of_a_run_are_what_the_model_encodes(runs, model):
    tokens = reviv.tokens("tiny", runs=runs)
    clips = {clip.id: clip for clip in reviv.clips("tiny", runs=runs)}
    assert len(tokens) == 6 and {"body", "camera", "gaze", "pixels"} <= set(tokens.modalities)
    for index, sample in enumerate(tokens):
        encoded = model.encode(clips[tokens.id(index)])
        for modality in ("body", "camera", "gaze"):
            assert np.array_equal(sample[modality], encoded[modality])
            assert encoded[modality].max() < model.vocabulary(modality)


def test_batches_hold_every_clip_once_and_say_what_is_missing(runs):
    tokens = reviv.tokens("tiny", modalities=["body", "left_hand"], runs=runs)
    batches = list(tokens.batches(4, seed=1))
    assert [len(batch.ids) for batch in batches] == [4, 2]
    assert sorted(name for batch in batches for name in batch.ids) == sorted(tokens.id(i) for i in range(6))
    for batch in batches:
        assert batch["body"].shape[0] == len(batch.ids) and batch.present["body"].all()
        for row, name in enumerate(batch.ids):
            index = next(i for i in range(6) if tokens.id(i) == name)
            assert np.array_equal(batch["body"][row], tokens[index]["body"])
    assert len(list(tokens.batches(4, drop_last=True))) == 1
    assert [b.ids for b in tokens.batches(4, seed=1)] == [b.ids for b in batches]
    with pytest.raises(reviv.Error, match="no tokens of `smell`"):
        reviv.tokens("tiny", modalities=["smell"], runs=runs)


def test_places_that_hold_nothing_are_refused_with_a_way_out(runs, tmp_path):
    with pytest.raises(reviv.Error, match="no shards below it"):
        reviv.clips(tmp_path)
    with pytest.raises(reviv.Error, match="no run `nowhere`"):
        reviv.clips("nowhere", runs=runs)
    with pytest.raises(reviv.Error, match="no split `tset`\nhint: it has: train, validation, test"):
        reviv.clips("tiny", "tset", runs=runs)
