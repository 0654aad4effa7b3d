//! Frames per second of 1080p video, all of them as RGB, beside those of `ffmpeg` alone: `cargo bench -p reviv-data --bench video`.
//!
//! The kitchen video of `$REVIV_SHARED/data/video`, five times over in each codec, on one core and on two: `taskset` holds
//! everything there, `ffmpeg` included. The ways take turns, and medians are printed. Aims, on the same threads: the embedded
//! decoder at least 0.6 times the frames of `ffmpeg`, through `ffmpeg` at most 1.3 times its time.

use reviv_data::video::{DecoderChoice, Video, VideoSettings, ffmpeg};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

const TURNS: usize = 3;
/// Repetitions, so that the start of a process is less than a twentieth of any time.
const LOOPS: &str = "4";
/// Pixels of a square, as clips have them.
const SIDE: u32 = 256;
const CODECS: [(&str, &str); 4] = [
    ("h264", "-c:v copy"),
    (
        "hevc",
        "-c:v libx265 -preset ultrafast -x265-params log-level=error",
    ),
    (
        "vp9",
        "-c:v libvpx-vp9 -deadline realtime -cpu-used 8 -b:v 8M",
    ),
    ("mjpeg", "-c:v mjpeg -q:v 3"),
];

fn main() {
    if std::env::args().any(|argument| argument == "measure") {
        measure();
        return;
    }
    let Some(source) = source().filter(|_| ffmpeg::available()) else {
        println!("needs `ffmpeg`, and the kitchen video in $REVIV_SHARED");
        return;
    };
    let codecs = CODECS.iter();
    let made: Vec<_> = codecs
        .filter_map(|(codec, how)| made(&source, codec, how))
        .collect();
    println!("{} videos; medians of {TURNS} turns, frames/s", made.len());
    let program = std::env::current_exe().expect("this program has a path");
    for cores in ["0", "0,1"] {
        let pinned = Command::new("taskset")
            .args(["-c", cores])
            .arg(&program)
            .arg("measure")
            .status();
        if !pinned.is_ok_and(|status| status.success()) {
            println!("no `taskset`, or no cores {cores}");
        }
    }
}

fn source() -> Option<PathBuf> {
    let root = std::env::var_os("REVIV_SHARED").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"),
        PathBuf::from,
    );
    let path = root.join("data/video/ego_kitchen_1080p30_4s.mp4");
    path.exists().then_some(path)
}

fn place(name: &str) -> PathBuf {
    std::env::temp_dir().join(format!("reviv_bench_{name}.mp4"))
}

fn run(before: &[&str], input: &Path, behind: &[&str], output: &Path) -> bool {
    let status = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error"])
        .args(before)
        .arg("-i")
        .arg(input)
        .args(["-map", "0:v:0"])
        .args(behind)
        .arg("-y")
        .arg(output)
        .stdin(Stdio::null())
        .status();
    status.is_ok_and(|status| status.success())
}

/// The video in this codec, coded once and repeated; kept for the next run.
fn made(source: &Path, codec: &str, how: &str) -> Option<PathBuf> {
    let path = place(codec);
    let once = place(&format!("{codec}_once"));
    let how: Vec<&str> = how.split(' ').collect();
    let done = path.is_file()
        || run(&[], source, &how, &once)
            && run(&["-stream_loop", LOOPS], &once, &["-c", "copy"], &path);
    done.then_some(path)
}

fn seconds(work: impl FnOnce()) -> f64 {
    let start = Instant::now();
    work();
    start.elapsed().as_secs_f64()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

type Way<'a> = (&'a str, Box<dyn Fn() + 'a>);

fn measure() {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    for (codec, _) in CODECS {
        let path = place(codec);
        let asked: Vec<String> = std::env::args().skip(2).collect();
        if path.is_file() && (asked.is_empty() || asked.iter().any(|name| name == codec)) {
            measure_codec(codec, &path, threads);
        }
    }
}

fn measure_codec(codec: &str, path: &Path, threads: usize) {
    let open = |decoder| {
        let video = Video::open_with(path, &VideoSettings::by(decoder));
        video.expect("the video opens")
    };
    let through = open(DecoderChoice::Ffmpeg);
    let count = through.info().frames;
    let every = |video: &Video| {
        let frames = video.frames(0..count).expect("the video is read");
        assert_eq!(frames.flatten().count(), count);
    };
    let squares = |video: &Video| {
        let squares = video.squares((0..count).collect(), SIDE, threads);
        let squares = squares.expect("the video is read");
        assert_eq!(squares.flatten().count(), count);
    };
    let by_itself = |most: usize| {
        let most = most.to_string();
        let threads = threads.to_string();
        let behind = ["-fps_mode", "passthrough", "-pix_fmt", "rgb24"];
        let behind = [&behind[..], &["-frames:v", &most, "-f", "rawvideo"]].concat();
        assert!(run(
            &["-threads", &threads],
            path,
            &behind,
            Path::new("/dev/null")
        ));
    };
    let (every, squares, by_itself) = (&every, &squares, &by_itself);
    let through = &through;
    let mut ways: Vec<Way<'_>> = vec![
        ("ffmpeg alone", Box::new(move || by_itself(count))),
        ("its first frame", Box::new(move || by_itself(1))),
        ("through ffmpeg", Box::new(move || every(through))),
    ];
    if codec == "h264" {
        let embedded = std::rc::Rc::new(open(DecoderChoice::Embedded));
        let same = std::rc::Rc::clone(&embedded);
        // Whole frames are decoded on the reader's thread, squares on all.
        if threads == 1 {
            ways.push(("embedded", Box::new(move || every(same.as_ref()))));
        }
        ways.push((
            "embedded, squares",
            Box::new(move || squares(embedded.as_ref())),
        ));
    }
    let mut taken = vec![Vec::new(); ways.len()];
    for _ in 0..TURNS {
        for ((_, work), taken) in ways.iter().zip(&mut taken) {
            taken.push(seconds(work));
        }
    }
    let taken: Vec<f64> = taken.into_iter().map(median).collect();
    for ((name, _), taken_by) in ways.iter().zip(&taken) {
        let label = format!("{codec}, {threads} threads, {name}");
        if *name == "its first frame" {
            println!("{label:44} {:7.3} of its time", taken_by / taken[0]);
            continue;
        }
        println!(
            "{label:44} {:7.1}  {:5.2} of its frames  {:5.2} of its time",
            count as f64 / taken_by,
            taken[0] / taken_by,
            taken_by / taken[0],
        );
    }
}
