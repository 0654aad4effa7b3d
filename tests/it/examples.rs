//! The programs of `examples/`, as the library's first page shows them, at tiny sizes.

use crate::tiny_movie::{Movie, Picture};
use reviv::{Flow, Model, TokenizerOptions, Tokenizers, TrainOptions, World};
use std::path::Path;

#[path = "../../examples/evaluate.rs"]
mod evaluate;
#[path = "../../examples/reconstruct.rs"]
mod reconstruct;
#[path = "../../examples/train.rs"]
mod train;

#[test]
fn a_model_is_trained_scored_and_reconstructs_a_video_without_yaml() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let (model, video, out) = (path("model"), path("walk.mp4"), path("out"));
    let tokenizers = TokenizerOptions::small().steps(3);
    train::run(&model, 6, &tokenizers, &TrainOptions::default().steps(3)).unwrap();

    let table = evaluate::run(&model, 2).unwrap();
    assert!(table.contains("reviv"), "{table}");

    let pictures = (0..30).map(|i| Picture::Flat(40 + 5 * i)).collect();
    std::fs::write(&video, Movie::new([64, 64], 10, pictures).bytes()).unwrap();
    reconstruct::run(&video, &model, &out).unwrap();
    for file in ["manifest.json", "view.html", "body.npz", "camera.tum"] {
        assert!(Path::new(&out).join(file).is_file(), "{file}");
    }
}

#[test]
fn training_stops_where_its_callback_says_and_a_written_model_is_the_same_model() {
    let clips = World::small().clips(0..4);
    let tokenizers = Tokenizers::fit(&clips, &TokenizerOptions::small().steps(1)).unwrap();
    let mut heard = 0;
    let stopped = Model::train(&tokenizers, &clips, &TrainOptions::default(), |_| {
        heard += 1;
        if heard == 3 {
            Flow::Stop
        } else {
            Flow::Continue
        }
    });
    assert!(stopped.unwrap_err().to_string().contains("stopped"));

    let options = TrainOptions::default().steps(1);
    let bytes = || {
        let folder = tempfile::tempdir().unwrap();
        let model = Model::train(&tokenizers, &clips, &options, |_| Flow::Continue).unwrap();
        model.write(folder.path()).unwrap();
        let again = Model::open(folder.path(), &reviv::Compute::cpu()).unwrap();
        let copy = tempfile::tempdir().unwrap();
        again.write(copy.path()).unwrap();
        let read = |folder: &Path| {
            let file = |name: &str| std::fs::read(folder.join(name)).unwrap();
            [file("model.json"), file("weights.safetensors")]
        };
        assert!(read(folder.path()) == read(copy.path()));
        read(copy.path())
    };
    assert!(bytes() == bytes());
}
