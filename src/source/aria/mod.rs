//! Recordings of Project Aria glasses: the container ([`vrs`]).

pub mod vrs;
