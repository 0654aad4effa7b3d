//! One integration test binary, a file per command or promise.
#![allow(clippy::unwrap_used)] // A test that cannot go on should stop where it is.
#![allow(
    clippy::duplicate_mod,
    reason = "examples that the tests run share a folder"
)]

mod adt_evaluation;
mod bad_input;
mod bad_input_binary;
mod circles;
mod damage;
mod data;
mod data_shares;
mod diagnostics;
mod egom2p_examples;
mod evaluation;
mod examples;
mod full_disk;
mod groups;
mod metrics;
mod modality_plugin;
mod motion_metrics;
mod mp4_edit;
mod odd_files;
mod odd_videos;
mod paper_runs;
mod parity;
mod pickles;
mod ranks;
#[cfg(feature = "mpi")]
mod ranks_mpi;
mod ranks_ops;
mod readers_bad;
mod reconstruct_command;
mod reconstruction;
mod recordings_bad;
mod recordings_golden;
mod recordings_video;
mod schema;
mod shared;
mod shipped;
mod skipped;
#[cfg(unix)]
mod slurm;
mod software_device;
mod statistics;
mod sweep_compare;
mod sweeps;
mod tiny_movie;
mod train_mget;
mod training;
mod trajectories;
mod video_matrix;
mod vrs_writer;

mod kill;
mod kill_binary;
mod language;
mod language_ops;
mod layouts;
mod layouts_bad;
mod layouts_hands;
mod plugins;
mod rules;
mod run;
mod run_text;
mod tensorboard;
mod tokenizer_ops;
mod view;
#[cfg(all(unix, not(target_os = "macos")))]
mod view_command;
mod vq_structure;
mod world;

mod hot3d_recording;
mod import;
mod import_bad;
mod import_models;
mod import_show;
mod import_used;
mod labelling;
mod released;
mod torch;
