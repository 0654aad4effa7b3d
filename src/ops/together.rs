//! Work that ranks share piece by piece: shards and batches, each made by one of them.
//!
//! Every rank sees the folders that rank 0 has made, and writes files that no other writes. Which rank makes which piece depends on
//! their number alone; what a piece holds does not, so that artifacts are the same bytes on any number of ranks.

use crate::engine::Communicator;
use crate::experiment::{Code, StageContext, StageError};
use std::path::Path;

/// Does `count` pieces of work in rounds, in each of them one on every rank. After each round all ranks hear whether one of them has
/// failed, or rank 0 is asked to stop; after the last they know that all pieces are there.
///
/// # Errors
/// What `work` says here, or on another rank; [`StageError::Interrupted`] on all where rank 0 is to stop.
pub(super) fn in_rounds(
    ranks: &Communicator,
    count: usize,
    context: &mut dyn StageContext,
    mut work: impl FnMut(usize, &mut dyn StageContext) -> Result<(), StageError>,
) -> Result<(), StageError> {
    let (rank, size) = (ranks.rank(), ranks.size());
    for round in 0..count.div_ceil(size).max(1) {
        let piece = round * size + rank;
        let mut stop = context.interrupted();
        let mut done = Ok(());
        if !stop && piece < count {
            done = work(piece, context);
        }
        if matches!(done, Err(StageError::Interrupted)) {
            // The others hear of it as of an interruption, not as of a failure.
            stop = true;
            done = Ok(());
        }
        let told = done.as_ref().map(|()| stop).map_err(ToString::to_string);
        let told = ranks.any(told);
        done?;
        if told.map_err(StageError::other)? {
            return Err(StageError::Interrupted);
        }
    }
    Ok(())
}

/// A file that another rank has written, and this one does not see.
pub(super) fn unseen(path: &Path) -> StageError {
    StageError::Input {
        code: Code::E0601,
        message: format!(
            "another rank has written `{}`, and rank 0 does not see it",
            path.display()
        ),
        help: "put `--runs` on a file system that all ranks share".into(),
    }
}
