//! Videos as cameras, phones and accidents leave them: turned, of varying rate, huge, cut off, empty, still, black. Each is read
//! right or refused with a reason, by the library and by `reviv reconstruct`.

use crate::reconstruct_command::Place;
use crate::tiny_movie::{Movie, Picture, container};
use reviv::video::{DecoderChoice, Video, VideoSettings};
use std::path::PathBuf;

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn file(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    }
}

/// By the embedded decoder, whether or not there is an `ffmpeg`.
fn open(path: &std::path::Path) -> Result<Video, String> {
    let settings = VideoSettings {
        decoder: DecoderChoice::Embedded,
        ..VideoSettings::default()
    };
    Video::open_with(path, &settings).map_err(|error| error.to_string())
}

/// Bright in the corner at the top left, darker to the right, darkest below.
fn corners(x: u32, y: u32) -> u8 {
    match (x < 32, y < 16) {
        (true, true) => 220,
        (false, true) => 150,
        (_, false) => 40,
    }
}

#[test]
fn turned_videos_come_out_upright() {
    let folder = Folder::new();
    // What is seen at the top left, top right, bottom left and bottom right.
    for (rotation, size, seen) in [
        (0, [64, 32], [220, 150, 40, 40]),
        (90, [32, 64], [40, 220, 40, 150]),
        (180, [64, 32], [40, 40, 150, 220]),
        (270, [32, 64], [150, 40, 220, 40]),
    ] {
        let movie = Movie {
            rotation,
            ..Movie::new([64, 32], 30, vec![Picture::Luma(corners), Picture::Again])
        };
        let video = open(&folder.file("turned.mp4", &movie.bytes())).unwrap();
        let info = video.info().clone();
        assert_eq!([info.width, info.height], size, "{rotation}");
        assert_eq!((info.rotation, info.frames), (rotation, 2));
        for frame in video.frames(0..2).unwrap() {
            let image = frame.unwrap().image;
            let [width, height] = size;
            let at = |x: u32, y: u32| image.data[3 * (y * width + x) as usize];
            let found = [
                at(2, 2),
                at(width - 3, 2),
                at(2, height - 3),
                at(width - 3, height - 3),
            ];
            // Of the luma a video has, 16 is black and 235 white.
            let expected = seen.map(|luma: i32| (luma - 16) * 255 / 219);
            for (found, expected) in found.into_iter().zip(expected) {
                assert!(
                    (i32::from(found) - expected).abs() <= 2,
                    "{rotation}: {found} {expected}"
                );
            }
        }
    }
}

#[test]
fn mirrored_videos_come_out_as_they_are_shown() {
    let folder = Folder::new();
    let one = 1 << 16;
    for (matrix, size, seen) in [
        ([-one, 0, 0, one], [64, 32], [150, 220, 40, 40]),
        ([one, 0, 0, -one], [64, 32], [40, 40, 220, 150]),
        ([0, one, one, 0], [32, 64], [220, 40, 150, 40]),
        ([0, -one, -one, 0], [32, 64], [40, 150, 40, 220]),
    ] {
        let movie = Movie {
            matrix: Some(matrix),
            ..Movie::new([64, 32], 30, vec![Picture::Luma(corners)])
        };
        let video = open(&folder.file("mirrored.mp4", &movie.bytes())).unwrap();
        assert!(video.info().mirrored);
        let image = video.frames(0..1).unwrap().next().unwrap().unwrap().image;
        let [width, height] = size;
        assert_eq!([image.width, image.height], size);
        let at = |x: u32, y: u32| image.data[3 * (y * width + x) as usize];
        let found = [
            (2, 2),
            (width - 3, 2),
            (2, height - 3),
            (width - 3, height - 3),
        ]
        .map(|(x, y)| f64::from(at(x, y)) * 219.0 / 255.0 + 16.0);
        for (found, seen) in found.into_iter().zip(seen) {
            assert!(
                (found - f64::from(seen)).abs() <= 2.0,
                "{matrix:?}: {found} {seen}"
            );
        }
    }
}

/// Luma 20 + 4 k says that a picture is number k.
fn numbers(video: &Video) -> Vec<usize> {
    let frames = video.frames(0..video.info().frames).unwrap();
    let luma = frames.map(|frame| f64::from(frame.unwrap().image.data[0]) * 219.0 / 255.0 + 16.0);
    luma.map(|luma| ((luma - 20.0) / 4.0).round() as usize)
        .collect()
}

fn numbered(count: u8) -> Vec<Picture> {
    (0..count).map(|at| Picture::Flat(20 + 4 * at)).collect()
}

#[test]
fn edit_lists_say_what_is_shown_and_when() {
    let folder = Folder::new();
    let one = 1 << 16;
    let read = |edits: Vec<(u32, i32, i32)>| {
        let movie = Movie {
            edits,
            ..Movie::new([16, 16], 10, numbered(40))
        };
        open(&folder.file("edited.mp4", &movie.bytes()))
    };
    let video = read(vec![(5, 3, one), (4, 30, one), (3, 3, one)]).unwrap();
    assert_eq!(numbers(&video), [3, 4, 5, 6, 7, 30, 31, 32, 33, 3, 4, 5]);
    assert_eq!((video.info().fps, video.info().seconds()), (10.0, 1.2));
    // A gap is time without frames.
    let video = read(vec![(7, -1, one), (5, 0, one), (10, -1, one), (5, 20, one)]).unwrap();
    assert_eq!(numbers(&video), [0, 1, 2, 3, 4, 20, 21, 22, 23, 24]);
    assert!((video.schedule().seconds(5) - 1.5).abs() < 1e-9);
    assert_eq!(
        numbers(&read(vec![(0, 35, one)]).unwrap()),
        [35, 36, 37, 38, 39]
    );
    for (edits, reason) in [
        (vec![(5, 0, 2 * one)], "changes the speed"),
        (vec![(5, 100, one)], "hides every frame"),
        (vec![(5, -3, one)], "starts before its media"),
        (vec![(40, 0, one); 1000], "without end"),
    ] {
        let said = read(edits).unwrap_err();
        assert!(
            said.contains(reason) && said.contains("edited.mp4"),
            "{said}"
        );
    }
}

#[test]
fn several_descriptions_empty_samples_and_trailers_are_read() {
    let folder = Folder::new();
    let two = Movie {
        second_entry: Some(11),
        ..Movie::new([16, 16], 30, numbered(20))
    };
    let video = open(&folder.file("two.mp4", &two.bytes())).unwrap();
    assert_eq!(numbers(&video), (0..20).collect::<Vec<_>>());

    let mut pictures = numbered(10);
    pictures[3] = Picture::Nothing;
    pictures[9] = Picture::Nothing;
    let video =
        open(&folder.file("empty.mp4", &Movie::new([16, 16], 10, pictures).bytes())).unwrap();
    assert_eq!(numbers(&video), [0, 1, 2, 4, 5, 6, 7, 8]);
    assert!((video.schedule().seconds(3) - 0.4).abs() < 1e-9);

    let trailer = [0x7f, 0xff, 0xff, 0xff, b'c', b'a', b'm', b'e', b'r', b'a'];
    let bytes = [
        Movie::new([16, 16], 10, numbered(5)).bytes(),
        trailer.to_vec(),
    ]
    .concat();
    assert_eq!(
        numbers(&open(&folder.file("trailer.mp4", &bytes)).unwrap()).len(),
        5
    );

    let shapes = container(*b"pasp", &[&4_u32.to_be_bytes(), &3_u32.to_be_bytes()]);
    let wide = Movie {
        shapes,
        ..Movie::new([48, 16], 10, numbered(2))
    };
    let video = open(&folder.file("wide.mp4", &wide.bytes())).unwrap();
    assert_eq!((video.info().width, video.info().height), (64, 16));
    assert_eq!(
        video
            .frames(1..2)
            .unwrap()
            .next()
            .unwrap()
            .unwrap()
            .image
            .width,
        64
    );
}

#[test]
fn a_varying_rate_gives_the_pictures_that_are_shown_at_the_times() {
    let folder = Folder::new();
    // 1 s of 30 pictures a second, then 1 s of 5; each picture's luma says which it is.
    let pictures: Vec<Picture> = (0..35).map(|at| Picture::Flat(20 + 6 * at)).collect();
    let mut durations = vec![1000; 30];
    durations.extend([6000; 5]);
    let movie = Movie {
        durations,
        timescale: 30_000,
        ..Movie::new([16, 16], 30, pictures)
    };
    let video = open(&folder.file("varying.mp4", &movie.bytes())).unwrap();
    assert!(video.info().variable_rate);
    assert_eq!(video.info().frames, 35);
    let clip = video.load_clip(0, 8.0, 16, 8).unwrap();
    for at in 0..16 {
        let found = f64::from(clip.frames[[at, 4, 4, 0]]);
        let shown = (found * 219.0 / 255.0 + 16.0 - 20.0) / 6.0;
        let index = shown.round() as usize;
        let seconds = video.schedule().seconds(index);
        let wanted = at as f64 / 8.0;
        // No other picture is nearer.
        let nearest = (0..35)
            .map(|frame| (video.schedule().seconds(frame) - wanted).abs())
            .fold(f64::INFINITY, f64::min);
        assert!(
            ((seconds - wanted).abs() - nearest).abs() < 1e-9,
            "{at}: picture {index} of {seconds} s for {wanted} s"
        );
    }
}

/// 40 pictures of 3840 x 2160 are 1 GB of colours; 700 MB of addresses are enough for the whole command.
#[test]
fn a_4k_video_at_60_frames_is_reconstructed_in_little_memory() {
    let place = Place::new();
    let mut pictures = vec![Picture::Luma(|x, y| (16 + (x / 64 + y / 64) % 200) as u8)];
    pictures.resize(40, Picture::Again);
    let movie = Movie::new([3840, 2160], 60, pictures);
    std::fs::write(place.path("huge.mp4"), movie.bytes()).unwrap();
    let video = open(&place.path("huge.mp4")).unwrap();
    let info = video.info();
    assert_eq!((info.width, info.height, info.frames), (3840, 2160, 40));
    assert!((info.fps - 60.0).abs() < 1e-9);

    let mut command = place.command("huge.mp4", "huge");
    if cfg!(target_os = "linux") {
        let inner = command;
        command = assert_cmd::Command::new("sh");
        command
            .args(["-c", "ulimit -v 700000; exec \"$0\" \"$@\""])
            .arg(inner.get_program())
            .args(inner.get_args())
            .current_dir(place.path(""))
            .env("RAYON_NUM_THREADS", "2");
    }
    command.assert().success();
    assert!(place.path("huge/camera.tum").is_file());
}

#[test]
fn still_black_short_and_turned_movies_are_reconstructed() {
    let place = Place::new();
    let still = vec![Picture::Luma(corners), Picture::Again, Picture::Again];
    let mut movies = vec![
        ("one", Movie::new([64, 32], 30, still[..1].to_vec())),
        (
            "black",
            Movie::new(
                [64, 32],
                30,
                [vec![Picture::Flat(16)], vec![Picture::Again; 40]].concat(),
            ),
        ),
        (
            "still",
            Movie::new(
                [64, 32],
                30,
                [still.clone(), vec![Picture::Again; 80]].concat(),
            ),
        ),
    ];
    movies.push((
        "turned",
        Movie {
            rotation: 90,
            ..Movie::new([64, 32], 30, [still, vec![Picture::Again; 60]].concat())
        },
    ));
    for (name, movie) in movies {
        let file = format!("{name}.mp4");
        std::fs::write(place.path(&file), movie.bytes()).unwrap();
        let output = place.command(&file, name).assert().success();
        let said = String::from_utf8_lossy(&output.get_output().stderr).into_owned();
        assert_eq!(
            said.contains("90 degrees, from the file"),
            name == "turned",
            "{said}"
        );
        let track = std::fs::read_to_string(place.path(name).join("camera.tum")).unwrap();
        for line in track.lines().filter(|line| !line.starts_with('#')) {
            let finite = |word: &str| word.parse::<f64>().is_ok_and(f64::is_finite);
            assert!(line.split_whitespace().all(finite), "{name}: {line}");
        }
        assert!(place.path(name).join("view.html").is_file());
    }
}

#[test]
fn a_movie_that_ends_early_is_refused_with_the_place() {
    let place = Place::new();
    let pictures: Vec<Picture> = (0..40).map(|at| Picture::Flat(20 + 5 * at)).collect();
    let bytes = Movie::new([32, 32], 30, pictures).bytes();
    let folder = Folder::new();
    let whole = open(&folder.file("whole.mp4", &bytes)).unwrap();
    assert_eq!(whole.frames(0..40).unwrap().map(Result::unwrap).count(), 40);
    // Inside the media, inside the index, inside the first box.
    for keep in [bytes.len() - 1, bytes.len() / 2, 700, 200, 20, 5, 0] {
        let path = folder.file("cut.mp4", &bytes[..keep]);
        let said = open(&path).err().unwrap_or_default();
        assert!(said.contains("cut.mp4"), "{keep}: {said}");
    }
    std::fs::write(place.path("half.mp4"), &bytes[..bytes.len() / 2]).unwrap();
    place.refuses("half.mp4", "half.mp4");
    place.refuses("half.mp4", "truncated?");
}

#[test]
fn a_movie_without_a_video_track_or_without_pictures_is_refused() {
    let place = Place::new();
    let sound = Movie {
        handler: *b"soun",
        ..Movie::new([32, 32], 30, vec![Picture::Flat(40)])
    };
    std::fs::write(place.path("sound.mp4"), sound.bytes()).unwrap();
    place.refuses("sound.mp4", "there is no video track");
    let none = Movie::new([32, 32], 30, Vec::new());
    std::fs::write(place.path("none.mp4"), none.bytes()).unwrap();
    place.refuses("none.mp4", "the video track has no samples");
}
