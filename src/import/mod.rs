//! Reading released weights of others without executing anything.

pub mod pickle;
