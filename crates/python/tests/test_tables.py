"""Scores, comparisons and the command line."""

import math

import pytest
import reviv
from conftest import command


def test_a_model_is_scored_beside_the_baselines(model, runs):
    heard = []
    table = reviv.evaluate(
        model, reviv.world(2, first=900), inputs=["pixels"], decoding="fast", progress=lambda *at: heard.append(at)
    )
    assert heard[-1] == (2, 2, "clips")
    assert "reviv" in table.rows and "body.ga_mpjpe" in table.columns
    assert table.values.shape == (len(table.rows), len(table.columns))
    assert math.isfinite(table["reviv", "body.ga_mpjpe"])
    assert "body.ga_mpjpe" in repr(table) or "ga_mpjpe" in repr(table)
    assert "<table>" in table._repr_html_()
    assert table.markdown().count("|") > 4 and "tabular" in table.latex() and "," in table.csv()
    with pytest.raises(KeyError, match="smell"):
        table["reviv", "smell"]


def test_clips_of_a_run_are_scored_by_name(model, runs):
    table = reviv.evaluate(model, "tiny", inputs=["pixels"], decoding="fast", runs=runs)
    assert math.isfinite(table["reviv", "camera.rte"])


def test_runs_are_compared_as_the_command_does(place, runs):
    table = reviv.compare("tiny", runs=runs)
    printed = command("compare", "tiny", folder=place).stdout
    assert repr(table) == printed
    with pytest.raises(reviv.Error, match="no run `nowhere`"):
        reviv.compare("nowhere", runs=runs)


def test_an_evaluation_is_stopped_by_its_callback(model):
    with pytest.raises(reviv.Stopped):
        reviv.evaluate(model, reviv.world(9), inputs=["pixels"], decoding="fast", progress=lambda *_: False)


def test_the_command_line_is_in_the_package(place, video, tmp_path):
    assert command("--version", folder=place).stdout.strip() == f"reviv {reviv.__version__}"
    refused = command("reconstruct", "nowhere.mp4", folder=place, check=False)
    assert refused.returncode == 1 and "no file `nowhere.mp4`" in refused.stderr
    made = command("reconstruct", video, "-o", tmp_path / "out", folder=place)
    assert made.stdout.strip().endswith("view.html")
    assert reviv.open(tmp_path / "out").body.positions.shape == (105, 21, 3)


def test_the_record_of_a_run_names_the_module_as_its_program(runs):
    import json

    locks = list(runs.glob("*/lock.json"))
    assert locks
    import hashlib  # noqa: F401

    assert all(json.loads(lock.read_text())["environment"]["binary"] for lock in locks)


def test_model_says_what_it_is(model):
    assert "tokens of body, camera, gaze, left_hand and raw video" in repr(model)
    assert "16 frames at 8 Hz, 64 x 64" in repr(model)
