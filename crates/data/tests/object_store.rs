//! Shards on an object store are those on a disk: the same bytes, found, read, verified and gone on with in the same way.
#![allow(clippy::unwrap_used)] // A test that cannot go on should stop where it is.

use reviv_data::clip::store::ClipSet;
use reviv_data::datasets::convert::{ConvertSettings, Converted, Progress, convert, whole};
use reviv_data::datasets::cut::CutSettings;
use reviv_data::datasets::open::{Dataset, OpenWith, open};
use reviv_data::datasets::shards::{Folder, Header, ShardClips};
use reviv_data::datasets::verify::verify;
use reviv_data::datasets::{ClipSource, Outcome};
use reviv_data::formats::object::InMemory;
use reviv_data::formats::{object, place};
use reviv_data::world::clips::WorldClips;
use reviv_data::world::{World, WorldSettings};
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

const SETTINGS: ConvertSettings = ConvertSettings {
    clips_per_shard: 2,
    skip_damaged: true,
};

fn world() -> WorldClips {
    let settings = WorldSettings {
        size: 16,
        ..WorldSettings::default()
    };
    WorldClips::new(World::new(settings, 4), 0..5)
}

fn header() -> Header {
    Header {
        source: "world".to_owned(),
        format: world().format().unwrap(),
        request: serde_json::json!({"clips": 5, "shards": SETTINGS}),
        tally: None,
    }
}

/// As `reviv data convert` does; stops when `most` clips are done.
fn converted(root: &Path, share: &str, most: usize) -> Converted {
    let folder = Folder::begin(root, header()).unwrap();
    let sink = folder.sink().unwrap();
    let watch = &mut |now: &Progress| {
        if now.done >= most {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    };
    let converted = convert(&world(), &sink, &SETTINGS, share.parse().unwrap(), watch).unwrap();
    if let Some(tally) = whole(5, &sink, &SETTINGS) {
        folder.finish(tally).unwrap();
    }
    converted
}

/// Every file below a local folder, by its path from there.
fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
    fn descend(root: &Path, folder: &Path, found: &mut BTreeMap<String, Vec<u8>>) {
        for (path, is_folder) in place::entries(folder).unwrap() {
            if is_folder {
                descend(root, &path, found);
            } else {
                let name = path.strip_prefix(root).unwrap().to_string_lossy();
                found.insert(name.into_owned(), std::fs::read(&path).unwrap());
            }
        }
    }
    let mut found = BTreeMap::new();
    descend(root, root, &mut found);
    found
}

fn fetched(address: &Path) -> BTreeMap<String, Vec<u8>> {
    let folder = tempfile::tempdir().unwrap();
    place::fetch(address, folder.path()).unwrap();
    files(folder.path())
}

#[test]
fn a_conversion_to_a_store_gives_the_bytes_of_one_to_a_disk() {
    object::mount("convert", Arc::new(InMemory::new()));
    let address = Path::new("s3://convert/some/clips");
    let folder = tempfile::tempdir().unwrap();
    let local = folder.path().join("clips");
    converted(&local, "1/1", usize::MAX);

    // Stopped in the middle, then made by two processes, one of which finds what is there.
    let stopped = converted(address, "1/1", 3);
    assert!(stopped.interrupted);
    let second = converted(address, "2/2", usize::MAX);
    assert_eq!((second.reused, second.interrupted), (0, false));
    let first = converted(address, "1/2", usize::MAX);
    assert_eq!((first.shards, first.reused), (2, 1));
    assert_eq!(fetched(address), files(&local));

    // Another conversion has no business there.
    let other = Header {
        source: "another".to_owned(),
        ..header()
    };
    let error = Folder::begin(address, other).unwrap_err().to_string();
    assert!(error.contains("another conversion"), "{error}");
    let error = Folder::begin(Path::new("s3://convert/some"), header());
    let error = error.unwrap_err().to_string();
    assert!(error.contains("is not empty"), "{error}");

    let found = verify(address).unwrap();
    assert_eq!(found.problems, [] as [String; 0]);
    assert_eq!((found.finished, found.tally.clips), (3, 5));
}

#[test]
fn clips_of_a_store_are_read_like_those_of_a_disk() {
    object::mount("read", Arc::new(InMemory::new()));
    let address = Path::new("s3://read/clips");
    let folder = tempfile::tempdir().unwrap();
    let local = folder.path().join("clips");
    converted(&local, "1/1", usize::MAX);
    converted(address, "1/1", usize::MAX);
    let there = ShardClips::open(address).unwrap();
    let here = ShardClips::open(&local).unwrap();
    assert_eq!(there.format(), here.format());
    assert_eq!(there.recordings(), here.recordings());
    assert_eq!(there.modalities(), here.modalities());
    for index in 0..5 {
        assert!(
            there.clip(index).unwrap() == here.clip(index).unwrap(),
            "{index}"
        );
    }
    let some = ClipSet::open(address)
        .unwrap()
        .clip_with(3, &["gaze"])
        .unwrap();
    assert!(some.gaze().is_some() && some.rgb().is_none());

    let as_kind = |kind| open(address, kind, &CutSettings::default(), OpenWith::default());
    for kind in [None, Some(Dataset::Shards)] {
        let source = as_kind(kind).unwrap();
        assert!(matches!(source.clip(4), Ok(Outcome::Clip(_))));
    }
    let Err(error) = as_kind(Some(Dataset::Nymeria)) else {
        panic!("recordings on an object store");
    };
    let error = error.to_string();
    assert!(
        error.contains("s3://read/clips") && error.contains("disk"),
        "{error}"
    );
}

#[test]
fn what_is_damaged_in_a_store_is_named() {
    object::mount("damage", Arc::new(InMemory::new()));
    let address = Path::new("s3://damage/clips");
    converted(address, "1/1", usize::MAX);
    let file = "rgb/world/shard-000001.tar";
    let good = place::read(&address.join(file)).unwrap();
    let mut bad = good.clone();
    bad[600] ^= 1;
    place::write(&address.join(file), &bad).unwrap();
    let problems = verify(address).unwrap().problems;
    assert_eq!(
        problems,
        [format!("`{file}` has other bytes than were written")]
    );
    place::write(&address.join(file), &good[..1024]).unwrap();
    let problems = verify(address).unwrap().problems.join("\n");
    assert!(problems.contains("has 1024 bytes instead of"), "{problems}");
    let error = ClipSet::open(address).unwrap_err().to_string();
    assert!(
        error.contains("s3://damage/clips") && error.contains(file),
        "{error}"
    );
    place::write(&address.join(file), &good).unwrap();
    assert!(verify(address).unwrap().problems.is_empty());

    let error = ShardClips::open(Path::new("s3://damage/nothing"));
    assert!(
        error
            .unwrap_err()
            .to_string()
            .contains("s3://damage/nothing")
    );
}
